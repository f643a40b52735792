"""The compiled part of `suppression`. Importing it needs numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled


@compiled(nogil=True)
def keep_distant(x, y, radii, cell, columns, rows):  # type: ignore[no-untyped-def]
    """Return which points, best first, have no kept point closer than the smaller of their radii.

    Args:
        x, y: (N,) float64 positions, all of them 0 or more.
        radii: (N,) float64 in pixels.
        cell: side of the cells of a grid that kept points are listed in.
        columns, rows: of that grid.

    Returns:
        (N,) bool.
    """
    kept = np.zeros(len(x), np.bool_)
    first = np.full((rows, columns), -1, np.int64)
    following = np.full(len(x), -1, np.int64)
    for k in range(len(x)):
        row, column = int(y[k] / cell), int(x[k] / cell)
        reach = int(np.ceil(radii[k] / cell))
        free = True
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for c in range(max(column - reach, 0), min(column + reach + 1, columns)):
                other = first[r, c]
                while other >= 0 and free:
                    radius = min(radii[k], radii[other])
                    free = (x[other] - x[k]) ** 2 + (y[other] - y[k]) ** 2 >= radius * radius
                    other = following[other]
        if free:
            kept[k] = True
            following[k], first[row, column] = first[row, column], k
    return kept
