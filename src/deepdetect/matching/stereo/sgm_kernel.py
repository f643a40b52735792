"""The compiled part of `sgm`. Importing it takes numba; the first call compiles.

Volumes are (H, W, D) with the disparity innermost, so that all disparities of a pixel are processed
at once in vector registers; sums are kept in 16 bits for the same reason.
"""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled

END = np.uint16(30000)
"""Cost beyond both ends of a path's disparities: more than any sum, and room to add a step."""


@compiled(nogil=True)
def census_rows(first, last, padded, out):  # type: ignore[no-untyped-def]
    """Write for each pixel of some rows which of its neighbours are darker, one bit each.

    Args:
        first, last: the rows.
        padded: uint8 image, padded by the radius of the window.
        out: (H, W) uint64, written.
    """
    height, width = out.shape
    radius_y, radius_x = (padded.shape[0] - height) // 2, (padded.shape[1] - width) // 2
    for y in range(first, last):
        out[y] = 0
        for j in range(-radius_y, radius_y + 1):
            for i in range(-radius_x, radius_x + 1):
                if i == 0 and j == 0:
                    continue
                for x in range(width):
                    here = padded[y + radius_y, x + radius_x]
                    darker = padded[y + radius_y + j, x + radius_x + i] < here
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
def _distances(left, right_mirrored, min_disparity, outside, out):  # type: ignore[no-untyped-def]
    """Write the Hamming distances of one row, (W, D) uint8."""
    width, count = out.shape
    for x in range(width):
        # The right column x - min_disparity - d is column width - 1 - (that) of the mirrored view.
        start = width - 1 - x + min_disparity
        low = min(max(0, -start), count)
        high = max(min(count, width - start), low)
        out[x, :low] = outside
        out[x, high:] = outside
        word = left[x]
        for d in range(low, high):
            out[x, d] = np.uint8(_count_bits(word ^ right_mirrored[start + d]))


@compiled(nogil=True)
def cost_rows(first, last, left, right_mirrored, min_disparity, outside, cost):  # type: ignore[no-untyped-def]
    """Write the costs of some rows.

    Args:
        first, last: the rows.
        left: (H, W) uint64 census of the left image.
        right_mirrored: (H, W) uint64 census of the right image, mirrored left to right.
        min_disparity: the disparity of `cost[..., 0]`.
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
            _distances(left[at], right_mirrored[at], min_disparity, outside, line)
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


@compiled(nogil=True, inline="always")
def _step(before, least, cost, total, after, p1, p2):  # type: ignore[no-untyped-def]
    """Go one pixel along a path; return the least cost there.

    Args:
        before: (D + 2,) uint16 costs of the path up to the pixel before, with an end each side.
        least: the least of them.
        cost: (D,) uint8 of this pixel.
        total: (D,) uint16 sum over the paths; grows.
        after: (D + 2,) uint16, written.
        p1, p2: penalty of a disparity one apart, and of any other.
    """
    count = cost.shape[0]
    jump = np.uint16(least + p2)
    lowest = np.uint16(65535)
    for d in range(count):
        path = min(before[d + 1], jump)
        path = min(path, np.uint16(before[d] + p1))
        path = min(path, np.uint16(before[d + 2] + p1))
        path = np.uint16(np.uint16(path - least) + np.uint16(cost[d]))
        after[d + 1] = path
        total[d] = np.uint16(total[d] + path)
        lowest = min(lowest, path)
    return lowest


@compiled(nogil=True)
def sum_along_rows(first, last, gray, cost, total, direction, p1, p2):  # type: ignore[no-untyped-def]
    """Add the paths along some rows, to the right (1) or to the left (-1).

    `p2` holds the penalty of a larger change of disparity for each change of the grey level.
    """
    width, count = cost.shape[1], cost.shape[2]
    lines = np.empty((2, count + 2), np.uint16)
    for y in range(first, last):
        lines[:] = 0
        lines[:, 0] = lines[:, count + 1] = END
        least = np.uint16(0)
        x = 0 if direction == 1 else width - 1
        tone = gray[y, x]
        for step in range(width):
            x = step if direction == 1 else width - 1 - step
            change = abs(np.int32(gray[y, x]) - np.int32(tone))
            tone = gray[y, x]
            least = _step(
                lines[step % 2], least, cost[y, x], total[y, x], lines[1 - step % 2],
                p1, p2[change],
            )  # fmt: skip


@compiled(nogil=True)
def sum_along_columns(  # type: ignore[no-untyped-def]
    first, last, gray, cost, total, direction, slant, p1, p2
):
    """Add the paths of some columns, down (1) or up (-1), `slant` columns to the right per row.

    A slanting path that leaves at one side starts again at the other, in its next row: so there
    are as many paths as columns, and each belongs to one call.
    """
    height, width, count = cost.shape
    lines = np.zeros((2, last - first, count + 2), np.uint16)
    lines[:, :, 0] = lines[:, :, count + 1] = END
    leasts = np.zeros(last - first, np.uint16)
    tones = np.zeros(last - first, np.uint8)
    for step in range(height):
        y = step if direction == 1 else height - 1 - step
        for path in range(last - first):
            x = (first + path + slant * step) % width
            if step == 0 or (slant == 1 and x == 0) or (slant == -1 and x == width - 1):
                lines[step % 2, path, 1 : count + 1] = 0
                leasts[path] = 0
                tones[path] = gray[y, x]
            change = abs(np.int32(gray[y, x]) - np.int32(tones[path]))
            tones[path] = gray[y, x]
            leasts[path] = _step(
                lines[step % 2, path], leasts[path], cost[y, x], total[y, x],
                lines[1 - step % 2, path], p1, p2[change],
            )  # fmt: skip


@compiled(nogil=True)
def best_of_rows(first, last, total, min_disparity, count, disparity, consistent, uniqueness_ratio):  # type: ignore[no-untyped-def]
    """Choose the disparity of least cost for each pixel of some rows, in both views.

    Args:
        first, last: the rows.
        total: (H, W, D) uint16 sum over the paths.
        min_disparity: the disparity of `total[..., 0]`.
        count: disparities that may be chosen, the first of the volume.
        disparity: (H, W) float32, written, with what a parabola through the least cost and its
            two neighbours adds.
        consistent: (H, W) bool, written: the disparity leads to a pixel of the right image whose
            best disparity is the same within one.
        uniqueness_ratio: (H, W) float32, written: of those, the least cost elsewhere inside the
            right image over the least cost; 1 where the disparity leads outside.
    """
    width = total.shape[1]
    best = np.empty(width, np.int64)
    keys = np.empty(width, np.uint32)
    for y in range(first, last):
        keys[:] = np.uint32(0xFFFFFFFF)
        for x in range(width):
            sums = total[y, x]
            # Places inside the right image: 0 <= x - min_disparity - d < width.
            low = min(max(0, x - min_disparity - width + 1), count)
            high = max(min(count, x - min_disparity + 1), low)
            inside = np.uint16(65535)
            for d in range(low, high):
                inside = min(inside, sums[d])
            least = inside
            for d in range(low):
                least = min(least, sums[d])
            for d in range(high, count):
                least = min(least, sums[d])
            # Where both are as good, the place that can be seen.
            seen = low < high and inside == least
            at = low if seen else 0
            while sums[at] != least:
                at += 1
            best[x] = at
            consistent[y, x] = seen
            uniqueness_ratio[y, x] = np.float32(1)
            fraction = np.float32(0)
            if seen:
                other = np.uint16(65535)
                for d in range(low, at - 1):
                    other = min(other, sums[d])
                for d in range(at + 2, high):
                    other = min(other, sums[d])
                ratio = np.float32(other) / np.float32(max(least, np.uint16(1)))
                uniqueness_ratio[y, x] = ratio
                if low < at < high - 1:
                    before, here, after = float(sums[at - 1]), float(least), float(sums[at + 1])
                    bend = before + after - 2 * here
                    if bend > 0:
                        fraction = np.float32(0.5 * (before - after) / bend)
            disparity[y, x] = np.float32(at + min_disparity) + fraction
            for d in range(low, high):
                key = (np.uint32(sums[d]) << np.uint32(16)) | np.uint32(d)
                keys[x - min_disparity - d] = min(keys[x - min_disparity - d], key)
        for x in range(width):
            if consistent[y, x]:
                from_right = np.int64(keys[x - min_disparity - best[x]] & np.uint32(0xFFFF))
                consistent[y, x] = abs(from_right - best[x]) <= 1
