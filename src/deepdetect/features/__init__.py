"""Keypoints, their selection and descriptors, and descriptor matching."""
