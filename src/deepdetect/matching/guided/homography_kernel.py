"""Compiled part of `homography`. Importing it needs numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled


@compiled(nogil=True)
def nearest_of_nine(first, last, places, grid, rows, best):  # type: ignore[no-untyped-def]
    """Find the nearest keypoint in the 3x3 pixels around the places from `first` to before `last`.

    Args:
        first, last: rows of the places.
        places: (N, 2) float64; not finite: none is found.
        grid: (H, W) int32 row of the keypoint on each pixel, or -1.
        rows: (N,) int32, written: that of the nearest keypoint where there is one.
        best: (N,) float64, written with its distance.
    """
    height, width = grid.shape
    for k in range(first, last):
        x, y = places[k, 0], places[k, 1]
        if not (-1.5 < x < width + 0.5 and -1.5 < y < height + 0.5):
            continue
        column, row = int(np.rint(x)), int(np.rint(y))
        nearest = np.inf
        for j in range(max(row - 1, 0), min(row + 2, height)):
            for i in range(max(column - 1, 0), min(column + 2, width)):
                distance = (i - x) ** 2 + (j - y) ** 2
                if grid[j, i] >= 0 and distance < nearest:
                    nearest = distance
                    rows[k] = grid[j, i]
        best[k] = np.sqrt(nearest)
