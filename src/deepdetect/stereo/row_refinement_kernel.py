"""The compiled part of `row_refinement`. Importing it takes numba; the first call compiles."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def smooth_rows(first, last, disparity, known, reach, step, out):  # type: ignore[no-untyped-def]
    """Write the mean disparity of the window around each known pixel of some rows.

    Args:
        first, last: the rows.
        disparity: (H, W) float32.
        known: (H, W) bool.
        reach: of the window, pixels to each side.
        step: pixels whose disparity differs by more belong to another surface.
        out: (H, W) float32, written where known.
    """
    height, width = disparity.shape
    for y in range(first, last):
        for x in range(width):
            if not known[y, x]:
                continue
            here = disparity[y, x]
            total, weight = np.float32(0), np.float32(0)
            # The window is cut alike on both sides, so that a slope is kept at the border.
            up = min(reach, y, height - 1 - y)
            side = min(reach, x, width - 1 - x)
            for j in range(y - up, y + up + 1):
                for i in range(x - side, x + side + 1):
                    there = disparity[j, i]
                    if known[j, i] and abs(there - here) <= step:
                        total += there
                        weight += np.float32(1)
            out[y, x] = total / weight


@njit(nogil=True, cache=True, fastmath=True)
def sample_rows(first, last, right, disparity, known, values, slopes):  # type: ignore[no-untyped-def]
    """Read the right image at x - disparity by cubic interpolation (Catmull-Rom), with slopes.

    Args:
        first, last: the rows.
        right: (H, W) float32.
        disparity: (H, W) float32.
        known: (H, W) bool.
        values, slopes: (H, W) float32, written where known: grey, and grey a pixel to the right.
    """
    width = right.shape[1]
    for y in range(first, last):
        for x in range(width):
            if not known[y, x]:
                continue
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


@njit(nogil=True, cache=True, fastmath=True)
def step_rows(  # type: ignore[no-untyped-def]
    first, last, left, values, slopes, disparity, known, reach, step, noise, out
):
    """Write the disparity after one step of Lucas-Kanade along the row.

    For each window the left grey is fitted by gain * (values - change * slopes) + offset.

    Args:
        first, last: the rows.
        left: (H, W) float32.
        values, slopes: as of `sample_rows`.
        disparity, known, reach, step: as of `smooth_rows`.
        noise: grey levels; the step shrinks where the slopes are no stronger.
        out: (H, W) float32, written where known.
    """
    height, width = disparity.shape
    for y in range(first, last):
        for x in range(width):
            if not known[y, x]:
                continue
            here = disparity[y, x]
            n = l = v = s = vv = ss = vs = lv = ls = np.float32(0)
            middle, other = left[y, x], values[y, x]
            for j in range(max(y - reach, 0), min(y + reach + 1, height)):
                for i in range(max(x - reach, 0), min(x + reach + 1, width)):
                    if known[j, i] and abs(disparity[j, i] - here) <= step:
                        a, b, c = left[j, i] - middle, values[j, i] - other, slopes[j, i]
                        n += np.float32(1)
                        l += a
                        v += b
                        s += c
                        vv += b * b
                        ss += c * c
                        vs += b * c
                        lv += a * b
                        ls += a * c
            vv -= v * v / n
            ss -= s * s / n
            vs -= v * s / n
            lv -= l * v / n
            ls -= l * s / n
            floor = n * noise * noise
            vv += floor
            lv += floor  # a flat window has gain 1
            ss += floor
            area = vv * ss - vs * vs
            gain = (lv * ss - ls * vs) / area
            moved = (ls * vv - lv * vs) / area
            change = np.float32(0)
            if gain > np.float32(0.2):
                change = -moved / gain
            out[y, x] = here + min(max(change, np.float32(-1)), np.float32(1))
