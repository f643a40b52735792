"""Training of the matcher: a network that matches keypoints by attention."""
