"""Panoramas: photographs registered with each other by dense matches, and put together."""

from .panorama import Panorama, stitch

__all__ = ["Panorama", "stitch"]
