"""Dense disparity maps of rectified pairs."""

from .matching import (
    DENSE,
    DisparityMap,
    DisparityOptions,
    RectifiedMatches,
    disparity_map,
    match_rectified,
)
from .sgm import DisparityRange

__all__ = [
    "DENSE",
    "DisparityMap",
    "DisparityOptions",
    "DisparityRange",
    "RectifiedMatches",
    "disparity_map",
    "match_rectified",
]
