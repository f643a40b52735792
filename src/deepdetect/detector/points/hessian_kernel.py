"""The compiled part of `hessian_scales`. Importing it needs numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled

QUARTER, QUARTER_SQUARED = np.float32(1 / 4), np.float32(1 / 16)


@compiled(nogil=True, fastmath=True)
def differentiate(start, stop, padded, variance, determinant, trace, gradient, strength):  # type: ignore[no-untyped-def]
    """Compute the derivatives of rows `start` to before `stop`, by central differences.

    Args:
        start, stop: rows.
        padded: (H + 2, W + 2) float32, the smoothed image with a border.
        variance: float32, sigma^2 in pixels, which derivatives are normalised by.
        determinant, trace, gradient, strength: (H, W) float32, written: of the Hessian
            determinant and trace, the squared magnitude of the gradient, and |determinant|.
    """
    width = determinant.shape[1]
    squared = variance * variance
    for y in range(start, stop):
        above, here, below = padded[y], padded[y + 1], padded[y + 2]
        for x in range(width):
            twice = here[x + 1] + here[x + 1]
            xx = here[x] - twice + here[x + 2]
            yy = above[x + 1] - twice + below[x + 1]
            xy = above[x] - above[x + 2] - below[x] + below[x + 2]
            dx, dy = here[x + 2] - here[x], below[x + 1] - above[x + 1]
            value = (xx * yy - xy * xy * QUARTER_SQUARED) * squared
            determinant[y, x] = value
            trace[y, x] = (xx + yy) * variance
            gradient[y, x] = (dx * dx + dy * dy) * (variance * QUARTER)
            strength[y, x] = abs(value)
