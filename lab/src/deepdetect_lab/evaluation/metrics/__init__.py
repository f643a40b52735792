"""Metrics of masks, keypoints, matches, homographies and disparities, against a known truth."""
