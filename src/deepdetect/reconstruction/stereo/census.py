"""The matching cost: the Hamming distance of census transforms.

The census transform (Zabih and Woodfill, "Non-parametric local transforms for computing visual
correspondence", ECCV 1994) says of a pixel which of its neighbours are darker: gain, offset and
gamma do not change it.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..._shared.parallel import parallel_for

REACH_X = 4
REACH_Y = 3
"""The window is 9 x 7 pixels: 62 comparisons, which fit a 64-bit word."""

BITS = (2 * REACH_X + 1) * (2 * REACH_Y + 1) - 1

UNITS = 9 / 4
"""Costs are sums over 3 x 3 pixels, divided by four to fit a byte: so many for a bit a pixel."""


def census(gray: np.ndarray) -> np.ndarray:
    """Return the census of each pixel of a (H, W) uint8 image, one bit a neighbour; uint64.

    Example:
        >>> image = np.full((20, 20), 7, np.uint8)
        >>> image[10, 10] = 9
        >>> [int(census(image)[row, 10]).bit_count() for row in (9, 10)]
        [0, 62]
    """
    from . import census_kernel as kernel

    framed = cv2.copyMakeBorder(gray, REACH_Y, REACH_Y, REACH_X, REACH_X, cv2.BORDER_REPLICATE)
    out = np.empty(gray.shape, np.uint64)
    parallel_for(len(gray), lambda first, last: kernel.census_rows(first, last, framed, out))
    return out


def matching_cost(left: np.ndarray, right: np.ndarray, smallest: int, count: int) -> np.ndarray:
    """Compute what each disparity of each pixel costs.

    Args:
        left, right: (H, W) uint64 census of both views.
        smallest: the first disparity.
        count: number of disparities, D.

    Returns:
        (H, W, D) uint8, a quarter of the distances' sum over 3 x 3 pixels. A place outside the
        right view is as distant as a wrong place is on average.

    Example:
        >>> words = np.zeros((8, 30), np.uint64)
        >>> words[4, 20] = 2**62 - 1
        >>> int(matching_cost(words, np.roll(words, -5, axis=1), 0, 16)[4, 20].argmin())
        5
    """
    from . import census_kernel as kernel

    cost = np.empty((*left.shape, count), np.uint8)
    # Mirrored, growing disparities lie at growing addresses.
    mirrored = np.ascontiguousarray(right[:, ::-1])
    outside = np.uint8(BITS // 2)
    parallel_for(
        len(left),
        lambda first, last: kernel.cost_rows(first, last, left, mirrored, smallest, outside, cost),
    )
    return cost


def textured(gray: np.ndarray) -> np.ndarray:
    """Tell which pixels of a (H, W) uint8 image have a window of more than one grey; (H, W) bool.

    Others have nothing to be matched by: burnt out or black, or drawn.

    Example:
        >>> image = np.full((20, 20), 7, np.uint8)
        >>> image[10, 10] = 20
        >>> int(textured(image).sum())
        63
    """
    window = np.ones((2 * REACH_Y + 1, 2 * REACH_X + 1), np.uint8)
    return cv2.dilate(gray, window) > cv2.erode(gray, window)
