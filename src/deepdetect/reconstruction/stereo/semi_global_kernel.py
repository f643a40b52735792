"""The compiled part of semi-global matching. Importing it takes numba; the first call compiles.

Volumes are (H, W, D) with the disparity innermost, so that all of a pixel's disparities are done
at once by the processor's wide registers; sums are kept in 16 bits for the same reason.
"""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled

END = np.uint16(30000)
"""Cost beyond both ends of a path's disparities: more than any sum, and room to add a step."""


@compiled(nogil=True, inline="always")
def _step(before, least, cost, total, after, small_step, large_step):  # type: ignore[no-untyped-def]
    """Go one pixel along a path; return the least cost there.

    Args:
        before: (D + 2,) uint16 costs of the path up to the pixel before, with an end each side.
        least: the least of them.
        cost: (D,) uint8 of this pixel.
        total: (D,) uint16 sum over the paths; grows.
        after: (D + 2,) uint16, written.
        small_step, large_step: what a disparity one apart, and any other, cost.
    """
    count = cost.shape[0]
    jump = np.uint16(least + large_step)
    lowest = np.uint16(65535)
    for d in range(count):
        path = min(before[d + 1], jump)
        path = min(path, np.uint16(before[d] + small_step))
        path = min(path, np.uint16(before[d + 2] + small_step))
        path = np.uint16(np.uint16(path - least) + np.uint16(cost[d]))
        after[d + 1] = path
        total[d] = np.uint16(total[d] + path)
        lowest = min(lowest, path)
    return lowest


@compiled(nogil=True)
def sum_along_rows(first, last, gray, cost, total, direction, small_step, large_steps):  # type: ignore[no-untyped-def]
    """Add the paths along some rows, to the right (1) or to the left (-1)."""
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
                small_step, large_steps[change],
            )  # fmt: skip


@compiled(nogil=True)
def sum_along_columns(  # type: ignore[no-untyped-def]
    first, last, gray, cost, total, direction, slant, small_step, large_steps
):
    """Add the paths of some columns, down (1) or up (-1), `slant` columns to the right a row.

    A slanting path that leaves at one side begins anew at the other, in its next row: so paths
    are as many as columns, and each belongs to one call.
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
                lines[1 - step % 2, path], small_step, large_steps[change],
            )  # fmt: skip


@compiled(nogil=True)
def best_of_rows(first, last, total, smallest, count, disparity, known, unique):  # type: ignore[no-untyped-def]
    """Choose the disparity of least cost for each pixel of some rows, in both views.

    Args:
        first, last: the rows.
        total: (H, W, D) uint16 sum over the paths.
        smallest: the disparity of `total[..., 0]`.
        count: disparities that may be chosen, the first of the volume.
        disparity: (H, W) float32, written, with what a parabola through the least cost and its
            two neighbours adds.
        known: (H, W) bool, written: the right pixel's best disparity is the same within one.
        unique: (H, W) float32, written: the least cost elsewhere over the least cost.
    """
    width = total.shape[1]
    best = np.empty(width, np.int64)
    keys = np.empty(width, np.uint32)
    for y in range(first, last):
        keys[:] = np.uint32(0xFFFFFFFF)
        for x in range(width):
            sums = total[y, x]
            # Only places inside the right image: 0 <= x - smallest - d < width.
            low = max(0, x - smallest - width + 1)
            high = min(count, x - smallest + 1)
            known[y, x] = low < high
            if low >= high:
                continue
            least = np.uint16(65535)
            for d in range(low, high):
                least = min(least, sums[d])
            at = low
            while sums[at] != least:
                at += 1
            other = np.uint16(65535)
            for d in range(low, at - 1):
                other = min(other, sums[d])
            for d in range(at + 2, high):
                other = min(other, sums[d])
            best[x] = at
            unique[y, x] = np.float32(other) / np.float32(max(least, np.uint16(1)))
            fraction = np.float32(0)
            if low < at < high - 1:
                before, here, after = float(sums[at - 1]), float(least), float(sums[at + 1])
                bend = before + after - 2 * here
                if bend > 0:
                    fraction = np.float32(0.5 * (before - after) / bend)
            disparity[y, x] = np.float32(at + smallest) + fraction
            for d in range(low, high):
                key = (np.uint32(sums[d]) << np.uint32(16)) | np.uint32(d)
                keys[x - smallest - d] = min(keys[x - smallest - d], key)
        for x in range(width):
            if known[y, x]:
                from_right = np.int64(keys[x - smallest - best[x]] & np.uint32(0xFFFF))
                known[y, x] = abs(from_right - best[x]) <= 1
