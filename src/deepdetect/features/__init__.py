"""Keypoints and their descriptors, and descriptor matching."""
