"""Compiled part of `keypoints.nearest_keypoints`. The first call compiles."""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled


@compiled(nogil=True)
def nearest_of_nine(first, last, places, xy, grid, nearest, distances):  # type: ignore[no-untyped-def]
    """Find the nearest keypoint in the 3x3 pixels around the places from `first` to before `last`.

    Args:
        first, last: rows of the places.
        places: (N, 2) float64; not finite: none is found.
        xy: (M, 2) float64 keypoints.
        grid: (H, W) int32 row of the keypoint on each pixel, or -1.
        nearest: (N,) int32, written: the row of the nearest keypoint where there is one.
        distances: (N,) float64, written.
    """
    height, width = grid.shape
    for k in range(first, last):
        x, y = places[k, 0], places[k, 1]
        if not (-1.5 < x < width + 0.5 and -1.5 < y < height + 0.5):
            continue
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        least = np.inf
        for j in range(max(row - 1, 0), min(row + 2, height)):
            for i in range(max(column - 1, 0), min(column + 2, width)):
                one = grid[j, i]
                if one < 0:
                    continue
                squared = (xy[one, 0] - x) ** 2 + (xy[one, 1] - y) ** 2
                if squared < least:
                    least = squared
                    nearest[k] = one
        distances[k] = np.sqrt(least)
