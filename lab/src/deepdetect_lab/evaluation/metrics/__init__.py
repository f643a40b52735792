"""Compare keypoints, matches, homographies, poses and disparities with ground truth."""
