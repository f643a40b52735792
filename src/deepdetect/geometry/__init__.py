"""Geometry between two images: homography, fundamental and essential matrix."""

from .errors import disparity_errors, epipolar_errors, transfer_errors, transform_points
from .estimation import Geometry, GeometryOptions, estimate_geometry

__all__ = [
    "Geometry",
    "GeometryOptions",
    "disparity_errors",
    "epipolar_errors",
    "estimate_geometry",
    "transfer_errors",
    "transform_points",
]
