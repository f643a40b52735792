"""An order of pixels that spreads them evenly, however many are taken."""

from __future__ import annotations

import numpy as np

MOST_BITS = 12
"""Of a coordinate; float32 holds the order exactly up to so many."""


def even_order(xy: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Rank positions so that the first ones of any number are spread over the image.

    It is Bayer's dither matrix, of the image's own size: neighbours come far apart in the order.

    Args:
        xy: (N, 2) positions; their nearest pixels count.
        size: (width, height) of the image.

    Returns:
        (N,) float32 in [0, 1), the first the lowest.

    Example:
        >>> even_order(np.array([[0, 0], [1, 0], [0, 1], [1, 1]]), (2, 2)).tolist()
        [0.0, 0.5, 0.75, 0.25]
    """
    column, row = np.rint(np.asarray(xy).reshape(-1, 2)).astype(np.int64).T
    bits = min(MOST_BITS, max(1, (max(size) - 1).bit_length()))
    order = np.zeros(len(row), np.int64)
    for _ in range(bits):  # the lowest bits of the position decide most
        order = 4 * order + 2 * ((column ^ row) & 1) + (row & 1)
        column, row = column >> 1, row >> 1
    return (order / 4**bits).astype(np.float32)
