"""Ranked keypoints of all scales: extrema of a scale space, ordered by a small learned ranker."""
