"""Points under a homography, and the accuracy of an estimated one: corner error and its AUC."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...geometry.transforms import transform_points

CORNER_THRESHOLDS_PX = (1.0, 3.0, 5.0)

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""(width, height) of both images."""


def inside(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return which (N, 2) points lie in an image, (N,) bool; false where one is not finite.

    The image reaches half a pixel beyond the centres of its outer pixels.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    return np.all((points >= -0.5) & (points < np.asarray(size) - 0.5), axis=1)


def project_visible(
    points: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Map (N, 2) points into another image; those that it does not show become NaN.

    A homography also maps what lies beyond its horizon, where the plane is not visible, but turns
    it inside out: the determinant of its Jacobian, det(H) / depth^3, is negative there.
    """
    depth = np.asarray(points, np.float64).reshape(-1, 2) @ homography[2, :2] + homography[2, 2]
    mapped = transform_points(points, homography)
    visible = inside(mapped, size) & (depth * np.linalg.det(homography) > 0)
    return np.where(visible[:, None], mapped, np.nan)


def corner_error(estimated: np.ndarray | None, true: np.ndarray, size: tuple[int, int]) -> float:
    """Return the mean distance of the first image's corners under two homographies, in pixels.

    The corners are the centres of the corner pixels (SuperPoint's metric, DeTone 2018). Infinite
    without an estimate.
    """
    if estimated is None:
        return float("inf")
    right, bottom = size[0] - 1, size[1] - 1
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
    gaps = transform_points(corners, estimated) - transform_points(corners, true)
    error = float(np.linalg.norm(gaps, axis=1).mean())
    return error if np.isfinite(error) else float("inf")


def accuracy_at(errors: Sequence[float], threshold: float) -> float:
    """Return the fraction of the errors that are at most the threshold; 0 when there are none."""
    return float(np.mean(np.asarray(errors) <= threshold)) if len(errors) else 0.0


def area_under_curve(errors: Sequence[float], threshold: float) -> float:
    """Return the mean, over all thresholds up to this one, of the accuracy.

    Each error e under the threshold T adds (T - e) / T: the exact area under the cumulative
    curve, with no interpolation between errors.
    """
    if not len(errors):
        return 0.0
    return float(np.clip(1 - np.asarray(errors) / threshold, 0, None).mean())
