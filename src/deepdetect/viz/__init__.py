"""Visualisations of keypoints, matches, heat maps and depth maps."""
