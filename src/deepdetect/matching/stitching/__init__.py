"""Panoramas: photographs registered with each other by dense matches, and put together."""

from .options import StitchingOptions
from .panorama import Panorama, stitch

__all__ = ["Panorama", "StitchingOptions", "stitch"]
