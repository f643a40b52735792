"""Decide from matches whether two images show a plane, a pure rotation, or the same view."""

from __future__ import annotations

import numpy as np

from .camera import Calibration, Camera, Size
from .estimation import (
    GeometryOptions,
    TwoViewModel,
    estimate_geometry,
    log10_nfa,
)
from .refinement import START_FOCAL_LENGTHS

GUIDING_THRESHOLDS_PX = {"homography": 3.0, "fundamental": 1.5}
"""Inlier thresholds in pixels of the models that guide matching. The keypoints of these models come
from reduced images, and are less accurate than those from full size."""

SCENE_THRESHOLDS_PX = {"homography": 2.0, "fundamental": 1.5}
"""Inlier thresholds in pixels of the models by which a rectified pair or a pure rotation is
recognised. Chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip."""

MAX_MEDIAN_MOTION_PX, MAX_MOTION_PX, MOTION_QUANTILE = 0.5, 3.0, 0.9
"""Two images show the same view only if the median motion of matches is below MAX_MEDIAN_MOTION_PX,
and the quantile MOTION_QUANTILE below MAX_MOTION_PX. Chosen like `SCENE_THRESHOLDS_PX`."""


def fit_model(
    points0: np.ndarray,
    points1: np.ndarray,
    model: str,
    size1: Size,
    threshold_px: float,
    seed: int = 0,
) -> TwoViewModel:
    """Fit a model to (M, 2) matches, and compute the logarithm of its number of false alarms."""
    options = GeometryOptions(inlier_threshold=threshold_px)
    geometry = estimate_geometry(points0, points1, model, seed=seed, options=options)
    if geometry.matrix is None:
        return TwoViewModel("none", None, geometry.inliers, float("inf"))
    alarms = log10_nfa(geometry.inliers, model, threshold_px, size1)
    return TwoViewModel(model, geometry.matrix, geometry.inliers, alarms)


def is_static(motion_px: np.ndarray) -> bool:
    """Return whether two images show the same view, given how far matches move, in pixels."""
    motion = np.abs(motion_px)
    return bool(
        np.median(motion) < MAX_MEDIAN_MOTION_PX
        and np.quantile(motion, MOTION_QUANTILE) < MAX_MOTION_PX
    )


def is_pure_rotation(points0: np.ndarray, points1: np.ndarray, calibration: Calibration) -> bool:
    """Return whether a rotation maps the first image's rays to those of their matches (Kabsch)."""
    rays0, rays1 = (
        rays / np.linalg.norm(rays, axis=1, keepdims=True)
        for rays in (calibration.camera0.rays(points0), calibration.camera1.rays(points1))
    )
    u, _, vt = np.linalg.svd(rays1.T @ rays0)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    seen = calibration.camera1.project(rays0 @ rotation.T)
    errors = np.linalg.norm(seen - points1, axis=1)
    return bool(np.median(errors) < SCENE_THRESHOLDS_PX["fundamental"])


def is_usual_rotation(points0: np.ndarray, points1: np.ndarray, sizes: tuple[Size, Size]) -> bool:
    """Return whether a rotation fits (M, 2) matches at one of `START_FOCAL_LENGTHS`."""
    for focal in START_FOCAL_LENGTHS:
        cameras = [Camera(size, focal * max(size)) for size in sizes]
        if is_pure_rotation(points0, points1, Calibration(cameras[0], cameras[1])):
            return True
    return False
