"""Dense disparity maps of rectified pairs."""

from .matching import DENSE, DisparityMap, DisparityOptions, RectifiedMatches, disparity_map

__all__ = ["DENSE", "DisparityMap", "DisparityOptions", "RectifiedMatches", "disparity_map"]
