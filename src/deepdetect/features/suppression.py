"""Greedy suppression of keypoints that come from maps of several scales."""

from __future__ import annotations

import numpy as np


def suppress_neighbors(xy: np.ndarray, scores: np.ndarray, radius_px: float) -> np.ndarray:
    """Go through points from the best to the worst; keep those that are not near a kept one.

    Args:
        xy: (N, 2) positions.
        scores: (N,), the higher the better; of equal scores the first row comes first.
        radius_px: near is strictly closer.

    Returns:
        (K,) rows that are kept, best first.

    Example:
        >>> xy = np.array([[0.0, 0], [1, 0], [2, 0], [9, 9]])
        >>> suppress_neighbors(xy, np.array([1.0, 2, 3, 0]), 2).tolist()
        [2, 0, 3]
    """
    from .suppression_kernel import keep_distant

    order = np.argsort(-np.asarray(scores), kind="stable")
    if not len(order):
        return order
    places = np.asarray(xy, np.float64).reshape(-1, 2)[order]
    places = places - places.min(0)
    columns, rows = (int(side) + 1 for side in places.max(0) / radius_px)
    x, y = (np.ascontiguousarray(axis) for axis in places.T)
    kept: np.ndarray = keep_distant(x, y, float(radius_px), columns, rows)
    return order[kept]
