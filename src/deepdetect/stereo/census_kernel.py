"""The compiled part of the matching cost. Importing it takes numba; the first call compiles.

The census transform (Zabih and Woodfill, "Non-parametric local transforms for computing visual
correspondence", 1994) says of a pixel which of its neighbours are darker: it does not change with
gain, offset or gamma. Its Hamming distance, summed over 3 x 3 pixels, is the cost of a disparity.
"""

from __future__ import annotations

import numpy as np
from numba import njit

REACH_X = 4
REACH_Y = 3
"""The census window is 9 x 7 pixels: 62 comparisons, which fit a 64-bit word."""

BITS = (2 * REACH_X + 1) * (2 * REACH_Y + 1) - 1

OUTSIDE = np.uint8(BITS // 2)
"""Distance to a place outside the right image: that to a wrong place, on average."""

UNITS = 9 / 4
"""Costs are sums over nine pixels, divided by four to fit a byte: so many for a bit a pixel."""


@njit(nogil=True, cache=True)
def census_rows(first, last, gray, out):  # type: ignore[no-untyped-def]
    """Write of each pixel of some rows which of its neighbours are darker, one bit each.

    Args:
        first, last: the rows.
        gray: (H + 2 REACH_Y, W + 2 REACH_X) uint8 image in a frame.
        out: (H, W) uint64, written.
    """
    width = out.shape[1]
    for y in range(first, last):
        out[y] = 0
        for j in range(-REACH_Y, REACH_Y + 1):
            for i in range(-REACH_X, REACH_X + 1):
                if i == 0 and j == 0:
                    continue
                for x in range(width):
                    here = gray[y + REACH_Y, x + REACH_X]
                    darker = gray[y + REACH_Y + j, x + REACH_X + i] < here
                    out[y, x] = (out[y, x] << np.uint64(1)) | np.uint64(darker)


@njit(nogil=True, cache=True, inline="always")
def _count_bits(word):  # type: ignore[no-untyped-def]
    """Count the bits of a 64-bit word; the compiler knows this form as one instruction."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@njit(nogil=True, cache=True)
def _distances(left, right_mirrored, smallest, out):  # type: ignore[no-untyped-def]
    """Write the Hamming distances of one row, (W, D) uint8."""
    width, count = out.shape
    for x in range(width):
        # The right column x - smallest - d lies at width - 1 - x + smallest + d of the mirrored.
        start = width - 1 - x + smallest
        low = min(max(0, -start), count)
        high = max(min(count, width - start), low)
        out[x, :low] = OUTSIDE
        out[x, high:] = OUTSIDE
        word = left[x]
        for d in range(low, high):
            out[x, d] = np.uint8(_count_bits(word ^ right_mirrored[start + d]))


@njit(nogil=True, cache=True)
def cost_rows(first, last, left, right_mirrored, smallest, cost):  # type: ignore[no-untyped-def]
    """Write the costs of some rows.

    Args:
        first, last: the rows.
        left: (H, W) uint64 census of the left image.
        right_mirrored: (H, W) uint64 census of the right image, mirrored left to right: so
            growing disparities lie at growing addresses.
        smallest: the disparity of `cost[..., 0]`.
        cost: (H, W, D) uint8, written.
    """
    height, width, count = cost.shape
    line = np.empty((width, count), np.uint8)
    sums = np.empty((3, width, count), np.uint8)  # along the row: at most 3 x 62
    done = first - 2
    for y in range(first, last):
        for row in range(max(y - 1, done + 1), y + 2):
            at = min(max(row, 0), height - 1)
            _distances(left[at], right_mirrored[at], smallest, line)
            for x in range(width):
                before, after = line[max(x - 1, 0)], line[min(x + 1, width - 1)]
                here, out = line[x], sums[row % 3, x]
                for d in range(count):
                    out[d] = np.uint8(np.uint8(before[d] + here[d]) + after[d])
            done = row
        for x in range(width):
            above, here, below = sums[(y + 2) % 3, x], sums[y % 3, x], sums[(y + 1) % 3, x]
            out = cost[y, x]
            for d in range(count):
                total = np.uint16(np.uint16(above[d]) + np.uint16(here[d]))
                out[d] = np.uint8(np.uint16(total + np.uint16(below[d])) >> np.uint16(2))
