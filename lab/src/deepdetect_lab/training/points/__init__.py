"""Training of the ranker of keypoints, on pairs of views of photographs."""
