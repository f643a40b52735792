"""Greedy suppression of keypoints that come from maps of several scales."""

from __future__ import annotations

import numpy as np

DISTANCE_STEP_PX = 0.25
"""To which the distance of `spread_by_distance` is found."""


def suppress_neighbors(
    xy: np.ndarray, scores: np.ndarray, radius_px: float | np.ndarray
) -> np.ndarray:
    """Go through points from the best to the worst; keep those that are not near a kept one.

    Args:
        xy: (N, 2) positions.
        scores: (N,), the higher the better; of equal scores the first row comes first.
        radius_px: near is strictly closer; (N,) radii: than the smaller one of both points.

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
    radii = np.broadcast_to(np.asarray(radius_px, np.float64), len(order))[order]
    cell = float(radii.min())
    columns, rows = (int(side) + 1 for side in places.max(0) / cell)
    x, y = (np.ascontiguousarray(axis) for axis in places.T)
    kept: np.ndarray = keep_distant(x, y, radii, cell, columns, rows)
    return order[kept]


def spread_by_distance(xy: np.ndarray, scores: np.ndarray, count: int) -> np.ndarray:
    """Choose the best points that are as far from each other as their number allows.

    Adaptive non-maximal suppression (Brown, Szeliski and Winder, 2005), by bisection of the
    distance (Bailo et al., 2018).

    Args:
        xy: (N, 2) positions.
        scores: (N,), the higher the better.
        count: how many to choose.

    Returns:
        (min(N, count),) rows, best first.

    Example:
        >>> xy = np.array([[0.0, 0], [1, 0], [9, 0]])
        >>> spread_by_distance(xy, np.array([3.0, 2, 1]), 2).tolist()
        [0, 2]
    """
    best = np.argsort(-np.asarray(scores), kind="stable")
    if count >= len(best):
        return best
    near, far = 0.0, float(np.linalg.norm(np.ptp(np.asarray(xy, np.float64), axis=0))) + 1
    while far - near > DISTANCE_STEP_PX:
        middle = (near + far) / 2
        kept = suppress_neighbors(xy, scores, middle)
        if len(kept) >= count:
            near, best = middle, kept
        else:
            far = middle
    return best[:count]
