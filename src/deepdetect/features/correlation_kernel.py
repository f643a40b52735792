"""The compiled part of `correlation`. Importing it takes numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled

LEAST = 1e-3
"""Of the product of the squared lengths: below it descriptors are the mean, and tell nothing."""


# No full fastmath: its approximate division and root do not give 0 for equal descriptors.
@compiled(nogil=True, fastmath={"reassoc", "nsz", "contract"})
def compare(start, stop, first, rows0, second, rows1, mean, out):  # type: ignore[no-untyped-def]
    """Write 1 - correlation of the pairs from `start` to before `stop` into `out`."""
    for k in range(start, stop):
        a, b = first[rows0[k]], second[rows1[k]]
        both = np.float32(0)
        one = np.float32(0)
        other = np.float32(0)
        for d in range(len(mean)):
            x = np.float32(a[d]) - mean[d]
            y = np.float32(b[d]) - mean[d]
            both += x * y
            one += x * x
            other += y * y
        out[k] = np.float32(1) - both / np.sqrt(max(one * other, np.float32(LEAST)))
