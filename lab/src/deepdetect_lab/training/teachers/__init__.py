"""Published networks whose descriptors at DeepDetect's keypoints teach the learned descriptor."""
