"""The compiled part of `census`. Importing it takes numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled


@compiled(nogil=True)
def census_rows(first, last, gray, out):  # type: ignore[no-untyped-def]
    """Write of each pixel of some rows which of its neighbours are darker, one bit each.

    Args:
        first, last: the rows.
        gray: uint8 image with a frame as wide as the window reaches.
        out: (H, W) uint64, written.
    """
    height, width = out.shape
    reach_y, reach_x = (gray.shape[0] - height) // 2, (gray.shape[1] - width) // 2
    for y in range(first, last):
        out[y] = 0
        for j in range(-reach_y, reach_y + 1):
            for i in range(-reach_x, reach_x + 1):
                if i == 0 and j == 0:
                    continue
                for x in range(width):
                    here = gray[y + reach_y, x + reach_x]
                    darker = gray[y + reach_y + j, x + reach_x + i] < here
                    out[y, x] = (out[y, x] << np.uint64(1)) | np.uint64(darker)


@compiled(nogil=True, inline="always")
def _count_bits(word):  # type: ignore[no-untyped-def]
    """Count the bits of a 64-bit word; the compiler knows this form as one instruction."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled(nogil=True)
def _distances(left, right_mirrored, smallest, outside, out):  # type: ignore[no-untyped-def]
    """Write the Hamming distances of one row, (W, D) uint8."""
    width, count = out.shape
    for x in range(width):
        # The right column x - smallest - d lies at width - 1 - x + smallest + d of the mirrored.
        start = width - 1 - x + smallest
        low = min(max(0, -start), count)
        high = max(min(count, width - start), low)
        out[x, :low] = outside
        out[x, high:] = outside
        word = left[x]
        for d in range(low, high):
            out[x, d] = np.uint8(_count_bits(word ^ right_mirrored[start + d]))


@compiled(nogil=True)
def cost_rows(first, last, left, right_mirrored, smallest, outside, cost):  # type: ignore[no-untyped-def]
    """Write the costs of some rows.

    Args:
        first, last: the rows.
        left: (H, W) uint64 census of the left image.
        right_mirrored: (H, W) uint64 census of the right image, mirrored left to right.
        smallest: the disparity of `cost[..., 0]`.
        outside: distance to a place outside the right image.
        cost: (H, W, D) uint8, written.
    """
    height, width, count = cost.shape
    line = np.empty((width, count), np.uint8)
    sums = np.empty((3, width, count), np.uint8)  # along the row: at most 3 x 62
    done = first - 2
    for y in range(first, last):
        for row in range(max(y - 1, done + 1), y + 2):
            at = min(max(row, 0), height - 1)
            _distances(left[at], right_mirrored[at], smallest, outside, line)
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
