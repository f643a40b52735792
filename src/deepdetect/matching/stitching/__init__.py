"""Panoramas: photographs registered with each other by dense matches, and put together."""

from .options import StitchingOptions
from .panorama import STAGES, Panorama, stitch

__all__ = ["STAGES", "Panorama", "StitchingOptions", "stitch"]
