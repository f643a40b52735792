"""How far an estimated relative pose is from the true one, and its AUC (SuperGlue, 2020)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...geometry.relative_pose import rotation_angle
from ...geometry.transforms import epipolar_errors

POSE_THRESHOLDS_DEG = (5.0, 10.0, 20.0)
"""Of the AUC."""

EPIPOLAR_THRESHOLD_PX = 1.0
"""Within which a match agrees with the true pose."""


def rotation_error(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between two (3, 3) rotations, in degrees from 0 to 180.

    Example:
        >>> rotation_error(np.eye(3), np.diag([-1.0, -1, 1]))
        180.0
    """
    return rotation_angle(estimated @ true.T)


def translation_error(estimated: np.ndarray, true: np.ndarray) -> float:
    """Return the angle between the directions of two translations, in degrees from 0 to 180.

    SuperGlue and glue-factory count an opposite direction as right (the smaller of the angle and
    180 degrees minus it); here it is wrong, as the points in front of the cameras decide it.

    Args:
        estimated, true: (3,) of any length. A true one of length 0 has no direction: the error
            is 0.

    Example:
        >>> translation_error(np.array([0, 0, 1.0]), np.array([0, 2.0, 0]))
        90.0
    """
    across = float(np.linalg.norm(np.cross(estimated, true)))
    return float(np.degrees(np.arctan2(across, np.dot(estimated, true))))


def pose_auc(errors: Sequence[float], threshold: float) -> float:
    """Return the area under the cumulative curve of the errors up to a threshold, over it.

    As SuperGlue and glue-factory compute it: the curve is drawn with straight lines from (0, 0)
    through the sorted errors, so it lies a little higher than `homography.area_under_curve`,
    whose curve has steps.

    Args:
        errors: one of each pair; infinite where it failed.
        threshold: above 0, in the errors' unit.

    Returns:
        In [0, 1]; 0 without errors.

    Example:
        >>> pose_auc([1.0, 3.0, float("inf"), float("inf")], 4.0)
        0.34375
    """
    if not len(errors):
        return 0.0
    curve = np.concatenate([[0.0], np.sort(np.asarray(errors, np.float64))])
    recall = np.arange(len(curve)) / len(errors)
    under = int(np.searchsorted(curve, threshold))
    x = np.append(curve[:under], threshold)
    y = np.append(recall[:under], recall[under - 1])
    return float(np.trapezoid(y, x) / threshold)


def epipolar_inlier_ratio(
    points0: np.ndarray,
    points1: np.ndarray,
    fundamental: np.ndarray,
    threshold_px: float = EPIPOLAR_THRESHOLD_PX,
) -> float:
    """Return the fraction of the matches that agree with a pose.

    The error is Sampson's distance: how far the two points must move together, as the root of the
    sum of both squares, to lie on epipolar lines of each other. Where the images have one scale
    it is the distance to the line in one image over the square root of 2. A match that slid along
    its line agrees too: this is an upper bound of the precision.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        fundamental: (3, 3) with x1^T F x0 = 0, the true one.
        threshold_px: under which a match agrees.

    Returns:
        In [0, 1]; 0 without matches.

    Example:
        >>> rows = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # lines are the rows
        >>> points = np.array([[5.0, 5.0], [5.0, 5.0]])
        >>> epipolar_inlier_ratio(points, points + [[9, 1.4], [9, 1.5]], rows)
        0.5
    """
    if not len(points0):
        return 0.0
    return float((epipolar_errors(points0, points1, fundamental) < threshold_px).mean())
