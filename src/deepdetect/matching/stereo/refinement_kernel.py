"""The compiled part of `refinement`. Importing it takes numba; the first call compiles.

Windows are summed with the pixels of a row innermost, many at once in vector registers. Arrays are
padded by `radius` pixels; unknown disparities are UNKNOWN, so far from any other that they are
never on the same surface.
"""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled

UNKNOWN = np.float32(1e9)

BLOCK = 128
"""Pixels of a row that are processed together, so that the sums stay in the nearest cache."""


@compiled(nogil=True, fastmath=True)
def smooth_rows(first, last, disparity, radius, max_difference, out):  # type: ignore[no-untyped-def]
    """Write the mean disparity of the same surface around each pixel of some rows.

    Pixels of the window count in pairs, one on each side of its centre, so that the mean of a
    slanted plane is its disparity at the centre, also beside an edge.

    Args:
        first, last: the rows.
        disparity: (H + 2 radius, W + 2 radius) float32, padded.
        radius: of the window, pixels to each side.
        max_difference: pixels whose disparity differs by more belong to another surface.
        out: (H, W) float32, written; of unknown pixels it means nothing.
    """
    width = out.shape[1]
    total, weight = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    for y in range(first, last):
        for start in range(0, width, BLOCK):
            count = min(BLOCK, width - start)
            here = disparity[y + radius, start + radius : start + radius + count]
            total[:] = 0
            weight[:] = 1
            for j in range(radius + 1):
                for i in range(-radius, radius + 1):
                    if j == 0 and i <= 0:
                        continue
                    left, right = start + radius - i, start + radius + i
                    above = disparity[y + radius - j, left : left + count]
                    below = disparity[y + radius + j, right : right + count]
                    for x in range(count):
                        one, other = above[x] - here[x], below[x] - here[x]
                        both = abs(one) <= max_difference and abs(other) <= max_difference
                        total[x] += one + other if both else np.float32(0)
                        weight[x] += np.float32(2) if both else np.float32(0)
            for x in range(count):
                out[y, start + x] = here[x] + total[x] / weight[x]


@compiled(nogil=True, fastmath=True)
def sample_rows(first, last, right, disparity, values, slopes):  # type: ignore[no-untyped-def]
    """Read the right image at x - disparity by cubic interpolation (Catmull-Rom), with slopes.

    Args:
        first, last: the rows.
        right: (H, W) float32.
        disparity: (H, W) float32.
        values, slopes: (H, W) float32, written: grey, and its change per pixel to the right.
    """
    width = right.shape[1]
    for y in range(first, last):
        for x in range(width):
            place = min(max(np.float32(x) - disparity[y, x], np.float32(0)), np.float32(width - 1))
            at = min(int(place), width - 2)
            t = np.float32(place - np.float32(at))
            a = right[y, max(at - 1, 0)]
            b = right[y, at]
            c = right[y, at + 1]
            d = right[y, min(at + 2, width - 1)]
            one = np.float32(0.5) * (c - a)
            two = a - np.float32(2.5) * b + np.float32(2) * c - np.float32(0.5) * d
            three = np.float32(1.5) * (b - c) + np.float32(0.5) * (d - a)
            values[y, x] = b + t * (one + t * (two + t * three))
            slopes[y, x] = one + t * (np.float32(2) * two + t * np.float32(3) * three)


@compiled(nogil=True, fastmath=True)
def step_rows(  # type: ignore[no-untyped-def]
    first, last, left, values, slopes, disparity, radius, max_difference, noise, min_gain, out
):
    """Write the disparity after one step of Lucas-Kanade along the row.

    In each window the left grey is fitted by gain * (values - change * slopes) + offset, over
    the pixels of the same surface.

    Args:
        first, last: the rows.
        left, values, slopes, disparity: (H + 2 radius, W + 2 radius) float32, padded.
        radius, max_difference: as of `smooth_rows`.
        noise: grey levels; the step shrinks where the slopes are no stronger.
        min_gain: where the contrast of the right view fits with less, there is no step.
        out: (H, W) float32, written.
    """
    width = out.shape[1]
    n, p, v, s, vv, ss, vs, pv, ps = np.empty((9, BLOCK), np.float32)
    for y in range(first, last):
        for start in range(0, width, BLOCK):
            count = min(BLOCK, width - start)
            row, column = y + radius, start + radius
            here = disparity[row, column : column + count]
            # Less the greys at the centre: the sums stay small, and exact.
            middle = left[row, column : column + count]
            other = values[row, column : column + count]
            # Sums over the window: pixels, left grey, right grey, slope, and their products.
            for total in (n, p, v, s, vv, ss, vs, pv, ps):
                total[:] = 0
            for j in range(-radius, radius + 1):
                for i in range(-radius, radius + 1):
                    at = column + i
                    depth = disparity[row + j, at : at + count]
                    first_view = left[row + j, at : at + count]
                    second_view = values[row + j, at : at + count]
                    slope = slopes[row + j, at : at + count]
                    for x in range(count):
                        same = abs(depth[x] - here[x]) <= max_difference
                        weight = np.float32(1) if same else np.float32(0)
                        a = weight * (first_view[x] - middle[x])
                        b = weight * (second_view[x] - other[x])
                        c = weight * slope[x]
                        n[x] += weight
                        p[x] += a
                        v[x] += b
                        s[x] += c
                        vv[x] += b * b
                        ss[x] += c * c
                        vs[x] += b * c
                        pv[x] += a * b
                        ps[x] += a * c
            for x in range(count):
                floor = n[x] * noise * noise
                spread = vv[x] - v[x] * v[x] / n[x] + floor
                steep = ss[x] - s[x] * s[x] / n[x] + floor
                mixed = vs[x] - v[x] * s[x] / n[x]
                covariance = pv[x] - p[x] * v[x] / n[x] + floor  # a flat window has gain 1
                moved = ps[x] - p[x] * s[x] / n[x]
                area = spread * steep - mixed * mixed
                gain = (covariance * steep - moved * mixed) / area
                change = (covariance * mixed - moved * spread) / area
                ratio = change / gain if gain > min_gain else np.float32(0)
                out[y, start + x] = here[x] + min(max(ratio, np.float32(-1)), np.float32(1))
