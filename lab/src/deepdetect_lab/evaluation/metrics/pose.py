"""Compute errors of relative poses, and of camera poses after alignment with the true ones."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from deepdetect.geometry.camera import PosedView
from deepdetect.geometry.relative_pose import rotation_angle
from deepdetect.geometry.similarity import least_squares_similarity
from deepdetect.geometry.transforms import epipolar_errors

POSE_THRESHOLDS_DEG = (5.0, 10.0, 20.0)
"""Thresholds of the AUC (area under the cumulative error curve), as in SuperGlue's paper."""

LINE_WIDTH = 0.01
"""Camera centres count as collinear if their spread across a line is below this fraction of the
spread along it. Chosen by hand."""

EPIPOLAR_THRESHOLD_PX = 1.0
"""A match agrees with the true pose if its Sampson distance is below this. Chosen by hand."""


def rotation_error(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between two (3, 3) rotations, in degrees from 0 to 180."""
    return rotation_angle(estimated @ true.T)


def translation_error(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between the directions of two translations, in degrees from 0 to 180.

    SuperGlue and glue-factory accept a translation in the opposite direction. Here such a
    translation has an error of 180 degrees, because it would put the points behind the cameras. If
    the true translation is 0, the error is 0.
    """
    across = float(np.linalg.norm(np.cross(estimated, true)))
    return float(np.degrees(np.arctan2(across, np.dot(estimated, true))))


def epipolar_inlier_ratio(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> float:
    """Return the fraction of matches whose Sampson distance is below `EPIPOLAR_THRESHOLD_PX`.

    Wrong matches that lie on the correct epipolar line count as inliers, so the fraction
    overestimates the precision of the matches. It is 0 without matches.
    """
    if not len(points0):
        return 0.0
    errors = epipolar_errors(points0, points1, fundamental)
    return float((errors < EPIPOLAR_THRESHOLD_PX).mean())


def camera_errors(
    views: Sequence[PosedView], truth: Sequence[PosedView]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Align N >= 3 estimated cameras with the true ones by a similarity transform; compare them.

    The transform fits the estimated camera centres to the true ones by least squares (Umeyama,
    1991). Returns three values: the (N,) distances of the aligned centres from the true ones, in
    the unit of the ground truth; the (N,) angles between aligned and true rotations in degrees; and
    the scale of the transform. If the true centres are collinear, the angles are NaN, because a
    rotation about the line is undetermined. All values are NaN if no transform can be fitted.
    """
    own = np.array([view.centre for view in views])
    true = np.array([view.centre for view in truth])
    moved = least_squares_similarity(own, true)
    if moved is None:
        return np.full(len(own), np.nan), np.full(len(own), np.nan), np.nan
    angles = np.array(
        [
            rotation_error(view.rotation @ moved.rotation.T, other.rotation)
            for view, other in zip(views, truth, strict=True)
        ]
    )
    along, across, _ = np.linalg.svd(true - true.mean(axis=0), compute_uv=False)
    if across <= LINE_WIDTH * along:
        angles[:] = np.nan
    return np.linalg.norm(moved.apply(own) - true, axis=1), angles, moved.scale


def relative_pose_errors(
    views: Mapping[str, PosedView], truth: Mapping[str, PosedView]
) -> list[float]:
    """Return the error of the relative pose for each pair of true cameras, in degrees.

    The error is the larger of the angular errors of rotation and translation. It is infinite if
    the estimate of one of the two cameras is missing.
    """
    errors = []
    for pair in itertools.combinations(sorted(truth), 2):
        if not set(pair) <= set(views):
            errors.append(float("inf"))
            continue
        moved, true = (each[pair[1]].relative_to(each[pair[0]]) for each in (views, truth))
        angle = rotation_error(moved.rotation, true.rotation)
        errors.append(max(angle, translation_error(moved.translation, true.translation)))
    return errors
