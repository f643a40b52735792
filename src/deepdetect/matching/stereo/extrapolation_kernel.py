"""The compiled part of `extrapolation`. Importing it takes numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled


@compiled(nogil=True, inline="always")
def _line_at(sums, first, last, x):  # type: ignore[no-untyped-def]
    """Return the value at x of the line through points first to last - 1.

    Column i of `sums` holds the sums of x, x * x, value and x * value of the points before i.
    """
    count = np.float64(last - first)
    sx, sxx = sums[0, last] - sums[0, first], sums[1, last] - sums[1, first]
    sv, sxv = sums[2, last] - sums[2, first], sums[3, last] - sums[3, first]
    spread = count * sxx - sx * sx
    slope = (count * sxv - sx * sv) / spread if spread > 0 else 0.0
    return (sv + slope * (count * x - sx)) / count


@compiled(nogil=True)
def extrapolate_rows(  # type: ignore[no-untyped-def]
    first, last, disparity, known, carried, sign, min_support, max_difference, out
):
    """Extrapolate the first known surface of some rows to the left, where it is not seen.

    Args:
        first, last: the rows.
        disparity: (H, W) float32.
        known: (H, W) bool.
        carried: (H, W) float32, whole disparities that the surfaces around suggest.
        sign: the other view shows x at x - sign * disparity: -1 in mirrored views.
        min_support: fewest known pixels that a line is fitted to.
        max_difference: of disparities on one surface.
        out: (H, W) float32, written where the surface is extrapolated.
    """
    width = disparity.shape[1]
    sums = np.zeros((4, width + 1), np.float64)
    for y in range(first, last):
        start = 0
        while start < width and not known[y, start]:
            start += 1
        # Of the surface no more is used than twice the distance that it is extrapolated.
        wanted = 2 * max(start, min_support)
        support = 0
        before = np.float32(0)
        for x in range(start, width):
            if not known[y, x]:
                continue
            here = disparity[y, x]
            if support == wanted or (support > 0 and abs(here - before) > max_difference):
                break
            before = here
            at, value = np.float64(x - start), np.float64(here)
            support += 1
            sums[0, support] = sums[0, support - 1] + at
            sums[1, support] = sums[1, support - 1] + at * at
            sums[2, support] = sums[2, support - 1] + value
            sums[3, support] = sums[3, support - 1] + at * value
        for x in range(start - 1, -1, -1):
            reach = max(start - x, min_support)
            if 2 * reach > support:
                break
            predicted = _line_at(sums, reach, 2 * reach, 0.0)
            if abs(predicted - _line_at(sums, 0, reach, 0.0)) > max_difference:
                break
            # Half a pixel for the rounding.
            if abs(carried[y, x] - disparity[y, start]) > max_difference + np.float32(0.5):
                continue
            continued = _line_at(sums, 0, 2 * reach, np.float64(x - start))
            if np.float64(x) - sign * continued < 0:
                out[y, x] = np.float32(continued)
