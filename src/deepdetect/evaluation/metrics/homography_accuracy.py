"""How far an estimated homography is off: the corner error, its shares and its AUC."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...geometry.residuals import transform_points

THRESHOLDS = (1.0, 3.0, 5.0)
"""Pixels."""


def corner_error(estimated: np.ndarray | None, true: np.ndarray, size: tuple[int, int]) -> float:
    """Return the mean distance between the corners of the first image under two homographies.

    Args:
        estimated: (3, 3) from the first image to the second, or None when there is none.
        true: (3, 3).
        size: (width, height) of the first image; its corners are the centres of its corner
            pixels (SuperPoint's measure, DeTone 2018).

    Returns:
        Pixels of the second image; infinite without an estimate.

    Example:
        >>> shift = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
        >>> corner_error(shift, np.eye(3), (10, 10))
        5.0
    """
    if estimated is None:
        return float("inf")
    right, bottom = size[0] - 1, size[1] - 1
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
    gaps = transform_points(corners, estimated) - transform_points(corners, true)
    error = float(np.linalg.norm(gaps, axis=1).mean())
    return error if np.isfinite(error) else float("inf")


def share_within(errors: Sequence[float], threshold: float) -> float:
    """Return the share of the errors that are at most the threshold; 0 when there are none."""
    return float(np.mean(np.asarray(errors) <= threshold)) if len(errors) else 0.0


def area_under_curve(errors: Sequence[float], threshold: float) -> float:
    """Return the mean, over all thresholds up to this one, of the share within it.

    Each error e under the threshold T adds (T - e) / T: the exact area under the cumulative
    curve, with no interpolation between errors.

    Example:
        >>> area_under_curve([0.0, 1.0, 9.0, float("inf")], 2.0)
        0.375
    """
    if not len(errors):
        return 0.0
    return float(np.clip(1 - np.asarray(errors) / threshold, 0, None).mean())
