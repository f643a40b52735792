"""Panoramas: registration of images by dense matches, and compositing."""

from .panorama import Panorama, StitchingOptions, stages_of, stitch

__all__ = ["Panorama", "StitchingOptions", "stages_of", "stitch"]
