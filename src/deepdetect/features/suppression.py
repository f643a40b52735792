"""Greedy suppression of keypoints that come from maps of several scales."""

from __future__ import annotations

import math
import sys

import numpy as np

MIN_COMPILED_POINTS = 30_000
"""From which importing the compiled code, where there is numba, takes less time than it saves.

The points of each pass count. Where numba has been imported already, compiled code is always taken.
"""

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
    order = np.argsort(-np.asarray(scores), kind="stable")
    if not len(order):
        return order
    places = np.asarray(xy, np.float64).reshape(-1, 2)[order]
    places = places - places.min(0)
    radii = np.broadcast_to(np.asarray(radius_px, np.float64), len(order))[order]
    cell = float(radii.min())
    columns, rows = (int(side) + 1 for side in places.max(0) / cell)
    if _saves_time(len(order)):
        from .kernels import keep_distant

        x, y = (np.ascontiguousarray(axis) for axis in places.T)
        kept: np.ndarray = keep_distant(x, y, radii, cell, columns, rows)
        return order[kept]
    return order[_keep_distant(places, radii, cell, columns)]


def _saves_time(points: int) -> bool:
    """Whether compiled code is worth its import for so many points."""
    return points >= MIN_COMPILED_POINTS or "numba" in sys.modules


def _keep_distant(places: np.ndarray, radii: np.ndarray, cell: float, columns: int) -> list[int]:
    """Return which points, best first, have no kept point closer than the smaller of their radii.

    The same as the compiled `keep_distant`, in Python.

    Args:
        places: (N, 2) positions, all of them 0 or more.
        radii: (N,) in pixels.
        cell: side of the cells of a grid that kept points are listed in.
        columns: of that grid.
    """
    reaches = np.ceil(radii / cell).astype(np.int64)
    margin = int(reaches.max())  # so that no cell beside a row is one of the next row
    width = columns + 2 * margin
    column, row = (places / cell).astype(np.int64).T
    cells = (row + margin) * width + column + margin
    near = {reach: _cells_around(reach, width) for reach in np.unique(reaches).tolist()}
    lists: dict[int, list[tuple[float, float, float]]] = {}
    kept = []
    points = zip(
        *(each.tolist() for each in (*places.T, radii * radii, cells, reaches)), strict=True
    )
    for k, (x, y, squared, own, reach) in enumerate(points):
        nearby = (lists[own + step] for step in near[reach] if own + step in lists)
        if not any(_is_near(x, y, squared, others) for others in nearby):
            kept.append(k)
            lists.setdefault(own, []).append((x, y, squared))
    return kept


def _is_near(x: float, y: float, squared: float, others: list[tuple[float, float, float]]) -> bool:
    for other_x, other_y, other_squared in others:
        least = squared if squared < other_squared else other_squared
        if (other_x - x) ** 2 + (other_y - y) ** 2 < least:
            return True
    return False


def _cells_around(reach: int, width: int) -> list[int]:
    """Return the steps to cells so near that they may hold a closer point, nearest first."""
    steps = range(-reach, reach + 1)
    around = sorted(
        (down**2 + across**2, down * width + across) for down in steps for across in steps
    )
    return [step for _, step in around]


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
    passes = math.ceil(math.log2(far / DISTANCE_STEP_PX))
    if _saves_time(passes * len(best)):
        from . import kernels  # noqa: F401 (each pass then finds it imported)
    while far - near > DISTANCE_STEP_PX:
        middle = (near + far) / 2
        kept = suppress_neighbors(xy, scores, middle)
        if len(kept) >= count:
            near, best = middle, kept
        else:
            far = middle
    return best[:count]
