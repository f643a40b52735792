"""Metrics of keypoints, matches, homographies, poses and disparities, with ground truth."""
