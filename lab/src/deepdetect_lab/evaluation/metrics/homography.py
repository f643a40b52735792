"""Evaluate points, matches and estimated homographies with the true homography."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deepdetect.geometry.transforms import transfer_errors, transform_points

CORNER_THRESHOLDS_PX = (1.0, 3.0, 5.0)

MATCH_THRESHOLDS_PX = tuple(range(1, 11))
"""Thresholds of the mean matching accuracy, as in D2-Net's paper."""

Sizes = tuple[tuple[int, int], tuple[int, int]]
"""(width, height) of each of the two images."""


def inside(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return which points (N, 2) are inside an image, (N,) bool; false if a point is not finite.

    The image extends half a pixel beyond the centres of its outer pixels.
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    return np.all((points >= -0.5) & (points < np.asarray(size) - 0.5), axis=1)


def project_visible(
    points: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Map points (N, 2) into another image. Points that the other image does not show become NaN.

    A homography also maps points beyond the horizon, where the plane is invisible. There it flips
    the orientation: the determinant of its Jacobian, det(H) / depth^3, is negative.
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
    """Evaluate matched positions (M, 2) of two images, given all keypoints (N, 2) of both.

    Returns the number of "matches", and three values for each threshold of 1 to 10 px in the second
    image. ("correct", px) is the number of matches within the threshold. ("precision", px) is their
    fraction, D2-Net's matching accuracy. ("score", px) is Mikolajczyk's matching score, the number
    of correct matches in the overlap divided by the number of keypoints that could have a match.
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
    """Return the mean distance between the image corners mapped by two homographies, in pixels.

    Corners are the centres of corner pixels, as in SuperPoint's metric (DeTone, 2018). The error is
    infinite without an estimate.
    """
    if estimated is None:
        return float("inf")
    right, bottom = size[0] - 1, size[1] - 1
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
    gaps = transform_points(corners, estimated) - transform_points(corners, true)
    error = float(np.linalg.norm(gaps, axis=1).mean())
    return error if np.isfinite(error) else float("inf")


def accuracy_at(errors: Sequence[float], threshold: float) -> float:
    """Return the fraction of the errors that are at most the threshold; 0 if there are none."""
    return float(np.mean(np.asarray(errors) <= threshold)) if len(errors) else 0.0


def area_under_curve(errors: Sequence[float], threshold: float) -> float:
    """Return the area under the cumulative error curve up to a threshold, divided by it.

    As in SuperGlue and glue-factory, the curve consists of straight lines from (0, 0). So the area
    exceeds the mean of `accuracy_at` by up to half the share of one error.
    """
    if not len(errors):
        return 0.0
    curve = np.concatenate([[0.0], np.sort(np.asarray(errors, np.float64))])
    recall = np.arange(len(curve)) / len(errors)
    under = int(np.searchsorted(curve, threshold))
    x = np.append(curve[:under], threshold)
    y = np.append(recall[:under], recall[under - 1])
    return float(np.trapezoid(y, x) / threshold)
