"""Geometry of one and two views: models, residuals, camera poses, refinement, rectification."""

from .estimation import Geometry, GeometryOptions, estimate_geometry
from .transforms import disparity_errors, epipolar_errors, transfer_errors, transform_points

__all__ = [
    "Geometry",
    "GeometryOptions",
    "disparity_errors",
    "epipolar_errors",
    "estimate_geometry",
    "transfer_errors",
    "transform_points",
]
