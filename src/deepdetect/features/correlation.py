"""How little pairs of descriptors have in common, without what all of them have."""

from __future__ import annotations

import numpy as np

from .._shared.threads import in_threads


def less_correlated(
    first: np.ndarray,
    rows0: np.ndarray,
    second: np.ndarray,
    rows1: np.ndarray,
    mean: np.ndarray,
) -> np.ndarray:
    """Compare pairs of descriptors by their correlation about a mean descriptor.

    Args:
        first, second: (N, D), (M, D) uint8 descriptors.
        rows0, rows1: (K,) rows of the pairs.
        mean: (D,) float32, taken away from both.

    Returns:
        (K,) float32: 1 - correlation, from 0 to 2: 0 where the two are equal, 0 but for rounding
        where they differ by a factor; 1 where one of them is the mean.

    Example:
        >>> a = np.array([[10, 20, 30], [30, 20, 10]], np.uint8)
        >>> mean = np.full(3, 20, np.float32)
        >>> less_correlated(a, np.array([0, 0]), a, np.array([0, 1]), mean).round(3)
        array([0., 2.], dtype=float32)
    """
    from .correlation_kernel import compare

    rows0, rows1 = (np.ascontiguousarray(rows, np.int64) for rows in (rows0, rows1))
    mean = np.ascontiguousarray(mean, np.float32)
    out = np.empty(len(rows0), np.float32)
    in_threads(
        len(out), lambda start, stop: compare(start, stop, first, rows0, second, rows1, mean, out)
    )
    return out
