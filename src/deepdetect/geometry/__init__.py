"""Geometry of one and two views: models, residuals, camera poses, refinement, rectification."""

from .estimation import Geometry, GeometryOptions, estimate_geometry
from .relative_pose import RelativePose, estimate_relative_pose
from .transforms import disparity_errors, epipolar_errors, transfer_errors, transform_points

__all__ = [
    "Geometry",
    "GeometryOptions",
    "RelativePose",
    "disparity_errors",
    "epipolar_errors",
    "estimate_geometry",
    "estimate_relative_pose",
    "transfer_errors",
    "transform_points",
]
