"""Images, keypoints, matches, depth maps and point clouds in files."""
