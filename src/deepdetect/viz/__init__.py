"""Pictures of keypoints, matches and point clouds."""
