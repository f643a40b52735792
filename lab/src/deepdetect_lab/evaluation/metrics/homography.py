"""Evaluate points, matches and estimated homographies of an image pair by its true homography."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deepdetect.geometry.transforms import transfer_errors, transform_points

CORNER_THRESHOLDS_PX = (1.0, 3.0, 5.0)

MATCH_THRESHOLDS_PX = (1, 3)
"""Matches with a transfer error up to these thresholds, in pixels, are counted as correct."""

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""(width, height) of each of the two images."""


def inside(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return an (N,) bool mask of the (N, 2) points that are inside an image of (width, height).

    The image ends half a pixel beyond its outer pixel centres. Non-finite points are outside.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    return np.all((points >= -0.5) & (points < np.asarray(size) - 0.5), axis=1)


def project_visible(
    points: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Map (N, 2) points into another image. Points that the other image does not show become NaN.

    Points behind the other camera also become NaN, even if the homography maps them into its image.
    The homography mirrors the image around these points, so the determinant of its Jacobian,
    det(H) / depth^3, is negative there.
    """
    depth = np.asarray(points, np.float64).reshape(-1, 2) @ homography[2, :2] + homography[2, 2]
    mapped = transform_points(points, homography)
    visible = inside(mapped, size) & (depth * np.linalg.det(homography) > 0)
    return np.where(visible[:, None], mapped, np.nan)


def match_accuracy(
    points0: np.ndarray,
    points1: np.ndarray,
    keypoints0: np.ndarray,
    keypoints1: np.ndarray,
    homography: np.ndarray,
    sizes: Sizes,
) -> dict[Any, Any]:
    """Evaluate the (M, 2) matches of two images by the true homography from first to second.

    `keypoints0` and `keypoints1` are all keypoints, (N, 2), matched or not. Errors are distances in
    the second image. Returns the number of "matches", and three values for each threshold `px` of
    `MATCH_THRESHOLDS_PX`. ("correct", px): number of matches with an error of at most px.
    ("precision", px): their fraction of all matches. ("score", px): Mikolajczyk's matching score,
    the number of correct matches of points that both images show, divided by the smaller number of
    keypoints in the overlap.
    """
    errors = transfer_errors(points0, points1, homography)
    back = np.linalg.inv(homography)

    def visible(points: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return np.isfinite(project_visible(points, matrix, size)[:, 0])

    fewest = min(
        visible(keypoints0, homography, sizes[1]).sum(), visible(keypoints1, back, sizes[0]).sum()
    )
    both = visible(points0, homography, sizes[1]) & visible(points1, back, sizes[0])
    found: dict[Any, Any] = {"matches": len(errors)}
    for px in MATCH_THRESHOLDS_PX:
        correct = errors <= px
        found["correct", px] = int(correct.sum())
        found["precision", px] = int(correct.sum()) / len(errors) if len(errors) else 0.0
        found["score", px] = int(correct[both].sum()) / int(fewest) if fewest else 0.0
    return found


def corner_error(estimated: np.ndarray | None, true: np.ndarray, size: tuple[int, int]) -> float:
    """Map the image corners by the estimated and the true homography; return their mean distance.

    The distance is in pixels. Corners are the centres of the corner pixels, as in SuperPoint's
    metric (DeTone, 2018). Without an estimated homography the error is infinite.
    """
    if estimated is None:
        return float("inf")
    right, bottom = size[0] - 1, size[1] - 1
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
    gaps = transform_points(corners, estimated) - transform_points(corners, true)
    error = float(np.linalg.norm(gaps, axis=1).mean())
    return error if np.isfinite(error) else float("inf")


def accuracy_at(errors: Sequence[float], threshold: float) -> float:
    """Return the fraction of the errors that are at most the threshold; 0 without errors."""
    return float(np.mean(np.asarray(errors) <= threshold)) if len(errors) else 0.0


def area_under_curve(errors: Sequence[float], threshold: float) -> float:
    """Return the area under the cumulative error curve (AUC) from 0 to a threshold, in [0, 1].

    The area is divided by the threshold. As in SuperGlue and glue-factory, straight lines connect
    (0, 0) with the points (error, fraction of errors up to this one).
    """
    if not len(errors):
        return 0.0
    curve = np.concatenate([[0.0], np.sort(np.asarray(errors, np.float64))])
    recall = np.arange(len(curve)) / len(errors)
    under = int(np.searchsorted(curve, threshold))
    x = np.append(curve[:under], threshold)
    y = np.append(recall[:under], recall[under - 1])
    return float(np.trapezoid(y, x) / threshold)
