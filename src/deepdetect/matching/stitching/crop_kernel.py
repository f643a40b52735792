"""The compiled part of cropping. Importing it takes numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled


@compiled(nogil=True)
def largest_rectangle(valid):  # type: ignore[no-untyped-def]
    """Return left, top, right and bottom of the largest rectangle that is true, for (H, W) bool.

    Row by row, of the columns' runs that end there, on a stack of growing runs.
    """
    height, width = valid.shape
    runs = np.zeros(width + 1, np.int64)  # the last one ends the row
    stack = np.empty(width + 1, np.int64)
    area, box = 0, (0, 0, 0, 0)
    for y in range(height):
        depth = 0
        for x in range(width + 1):
            if x < width:
                runs[x] = runs[x] + 1 if valid[y, x] else 0
            while depth > 0 and runs[stack[depth - 1]] >= runs[x]:
                depth -= 1
                run = runs[stack[depth]]
                left = stack[depth - 1] + 1 if depth > 0 else 0
                if run * (x - left) > area:
                    area, box = run * (x - left), (left, y + 1 - run, x, y + 1)
            stack[depth] = x
            depth += 1
    return box
