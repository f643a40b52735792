"""Panoramas: images registered with each other by dense matches, and composited."""

from .panorama import Panorama, StitchingOptions, stages_of, stitch

__all__ = ["Panorama", "StitchingOptions", "stages_of", "stitch"]
