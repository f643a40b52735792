"""The detector: the network, its heat map and its keypoints."""
