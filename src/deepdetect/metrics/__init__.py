"""Measures of keypoints and matches against a true geometry."""

from .repeatability import published_repeatability, repeated

__all__ = ["published_repeatability", "repeated"]
