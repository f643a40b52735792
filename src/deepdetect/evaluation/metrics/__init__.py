"""Measures of keypoints and matches against a true geometry."""

from .repeatability import published_repeatability, repeated
from .stereo_matches import StereoScore, stereo_score

__all__ = ["StereoScore", "published_repeatability", "repeated", "stereo_score"]
