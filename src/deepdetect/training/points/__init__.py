"""Training of the head that ranks keypoints, on pairs of views of photographs."""
