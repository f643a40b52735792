"""Keypoints chosen for where they are: spread over an image, or apart from each other."""

from __future__ import annotations

import functools
import math
import sys
from typing import Any

import numpy as np

GRID_CELLS = 24
"""Along the longer side of the image; each cell gives its strongest keypoints in turn, so that all
parts of the image have some."""

MIN_COMPILED_POINTS = 30_000
"""From which the import of numba takes less time than it saves, where nothing else has done it."""

DISTANCE_STEP_PX = 0.25
"""To which the distance of `spread_by_distance` is found."""


def grid_subsample(xy: np.ndarray, grid_size_px: int, seed: int = 0) -> np.ndarray:
    """Choose one random of (N, 2) positions of each cell of a grid; (K,) rows in rising order."""
    cell = np.floor(np.asarray(xy, np.float64) / grid_size_px).astype(np.int64)
    order = np.random.default_rng(seed).permutation(len(cell))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(order[first])


def spread_over_grid(
    xy: np.ndarray,
    scores: np.ndarray,
    image_size: tuple[int, int],
    max_keypoints: int,
    grid_cells: int = GRID_CELLS,
) -> np.ndarray:
    """Choose keypoints by score, in turn from all cells of a grid.

    Returns at most `max_keypoints` rows: first the best of each cell, then the second-best, ...
    `grid_cells` are along the longer side of the image.
    """
    side = max(image_size) / grid_cells
    cell = np.floor(np.maximum(xy, 0) / side).astype(np.int64)
    cell = cell[:, 1] * (grid_cells + 1) + cell[:, 0]
    order = np.lexsort((-scores, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    begins = np.repeat(first, np.diff(first, append=len(order)))
    rank = np.arange(len(order)) - begins
    return order[np.lexsort((-scores[order], rank))][:max_keypoints]


def suppress_neighbors(
    xy: np.ndarray, scores: np.ndarray, radius_px: float | np.ndarray
) -> np.ndarray:
    """Go through points from the best; return the rows that are not near a kept one, best first.

    Near is strictly closer than the radius, or of (N,) radii than the smaller one of both points.
    Of equal scores the first row comes first.
    """
    order = np.argsort(-np.asarray(scores), kind="stable")
    if not len(order):
        return order
    positions = np.asarray(xy, np.float64).reshape(-1, 2)[order]
    x, y = np.ascontiguousarray((positions - positions.min(0)).T)
    radii = np.broadcast_to(np.asarray(radius_px, np.float64), len(order))[order]
    cell = float(radii.min())
    columns, rows = int(x.max() / cell) + 1, int(y.max() / cell) + 1
    arrays = x, y, radii, np.full(rows * columns, -1), np.full(len(order), -1)
    if len(order) < MIN_COMPILED_POINTS and "numba" not in sys.modules:
        kept = _keep_distant(cell, columns, *(each.tolist() for each in arrays))  # type: ignore[no-untyped-call]
        return order[kept]
    return order[_compiled_keep_distant()(cell, columns, *arrays)]


def _keep_distant(cell, columns, x, y, radii, last, before):  # type: ignore[no-untyped-def]
    """Return which points, best first, have no kept one closer than the smaller of their radii.

    Positions are 0 or more. Kept points are chained by square cells: `last` holds the last one of
    each cell, `before` the one before each point; both are -1 where there is none.
    """
    kept = []
    rows = len(last) // columns
    for k in range(len(x)):
        row, column, reach = int(y[k] / cell), int(x[k] / cell), math.ceil(radii[k] / cell)
        left, right = max(column - reach, 0), min(column + reach + 1, columns)
        free = True
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for near in range(r * columns + left, r * columns + right):
                other = last[near]
                while other >= 0 and free:
                    radius = min(radii[k], radii[other])
                    free = (x[other] - x[k]) ** 2 + (y[other] - y[k]) ** 2 >= radius * radius
                    other = before[other]
        if free:
            kept.append(k)
            own = row * columns + column
            before[k], last[own] = last[own], k
    return kept


@functools.cache
def _compiled_keep_distant() -> Any:
    from .._shared.kernels import compiled

    return compiled(nogil=True)(_keep_distant)


def spread_by_distance(xy: np.ndarray, scores: np.ndarray, count: int) -> np.ndarray:
    """Choose the best points that are as far from each other as their number allows, best first.

    Adaptive non-maximal suppression (Brown, Szeliski and Winder, 2005), by bisection of the
    distance (Bailo et al., 2018).
    """
    import numba  # noqa: F401 (each of the many passes then finds it imported)

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
