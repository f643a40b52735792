"""Panoramas: images registered with each other by dense matches, and composited."""

from .panorama import STAGES, Panorama, StitchingOptions, stitch

__all__ = ["STAGES", "Panorama", "StitchingOptions", "stitch"]
