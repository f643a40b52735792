"""Keypoints chosen for where they are: spread over an image, or apart from each other."""

from __future__ import annotations

import numpy as np

GRID_CELLS = 24
"""Along the longer side; each cell gives its strongest keypoints in turn: all parts have some."""

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


def descending_order(values: np.ndarray) -> np.ndarray:
    """Return the rows of (N,) numbers from the highest, of float32 several times as fast as NumPy.

    Of equal numbers the first row comes first.
    """
    if values.dtype != np.float32:
        return np.argsort(-values, kind="stable")
    # The bits of floats rise with their magnitude, below 0 too.
    bits = (values + np.float32(0)).view(np.int32)
    keys = np.where(bits < 0, bits & 0x7FFFFFFF, ~bits).astype(np.int64) << 32
    keys |= np.arange(len(values))
    keys.sort()
    return keys & 0xFFFFFFFF


def suppress_neighbors(
    xy: np.ndarray,
    scores: np.ndarray,
    radius_px: float | np.ndarray,
    max_count: int | None = None,
) -> np.ndarray:
    """Go through points from the best; return the rows that are not near a kept one, best first.

    Near is strictly closer than the radius, or of (N,) radii than the smaller one of both points.
    Of equal scores the first row comes first. With `max_count` at most the first so many.
    """
    from .kernels import keep_distant

    order = descending_order(np.asarray(scores))
    if not len(order):
        return order
    positions = np.asarray(xy, np.float64).reshape(-1, 2)[order]
    x, y = np.ascontiguousarray((positions - positions.min(0)).T)
    radii = np.broadcast_to(np.asarray(radius_px, np.float64), len(order))[order]
    cell = float(radii.min())
    columns, rows = int(x.max() / cell) + 1, int(y.max() / cell) + 1
    kept = np.empty(len(order) if max_count is None else min(max_count, len(order)), np.int64)
    chains = np.full(rows * columns, -1), np.full(len(order), -1)
    return order[kept[: keep_distant(cell, columns, x, y, radii, *chains, kept)]]


def spread_by_distance(xy: np.ndarray, scores: np.ndarray, count: int) -> np.ndarray:
    """Choose the best points that are as far from each other as their number allows, best first.

    Adaptive non-maximal suppression (Brown et al., 2005), by bisection (Bailo et al., 2018).
    """
    best = descending_order(np.asarray(scores))
    if count >= len(best):
        return best
    near, far = 0.0, float(np.linalg.norm(np.ptp(np.asarray(xy, np.float64), axis=0))) + 1
    while far - near > DISTANCE_STEP_PX:
        middle = (near + far) / 2
        kept = suppress_neighbors(xy, scores, middle, count)
        if len(kept) >= count:
            near, best = middle, kept
        else:
            far = middle
    return best[:count]
