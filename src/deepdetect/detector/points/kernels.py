"""Compiled parts of the detection of points: derivatives, maxima, measurements of candidates."""

from __future__ import annotations

import math

import numpy as np

from ..._shared.kernels import compiled
from ...features.selection import MAX_OFFSET_PX
from .hessian_scales import LEAST_RESPONSE, NMS_RADIUS

_WINDOW = 2 * NMS_RADIUS + 1


@compiled(nogil=True)
def _determinant(above, here, below, left, x, right):  # type: ignore[no-untyped-def]
    # In this order: the differences are small, so that little is rounded.
    double = np.float32(2) * here[x]
    xx = (here[left] - double) + here[right]
    yy = (above[x] - double) + below[x]
    xy = (below[right] - below[left]) - (above[right] - above[left])
    return xx * yy - xy * xy * np.float32(1 / 16)


@compiled(nogil=True)
def differentiate(first, last, smooth, variance, determinant):  # type: ignore[no-untyped-def]
    """Compute the determinant of the Hessian, normalised by the variance, of some rows.

    By central differences in a (H, W) float32 image that is mirrored at its outermost pixels.
    """
    height, width = smooth.shape
    scale = variance * variance
    for row in range(first, last):
        here, out = smooth[row], determinant[row]
        above = smooth[row - 1 if row else min(1, height - 1)]
        below = smooth[row + 1 if row + 1 < height else max(height - 2, 0)]
        for x in range(1, width - 1):
            out[x] = _determinant(above, here, below, x - 1, x, x + 1) * scale
        near, end = min(1, width - 1), width - 1
        out[0] = _determinant(above, here, below, near, 0, near) * scale
        out[end] = _determinant(above, here, below, end - near, end, end - near) * scale


@compiled(nogil=True)
def find_peaks(determinant):  # type: ignore[no-untyped-def]
    """Return (N, 2) pixels (row, column), and (N, 2) positions (x, y), of maxima of |determinant|.

    Of all windows of `NMS_RADIUS`, but none in the outermost rows and columns.
    """
    height, width = determinant.shape
    padded = np.zeros(width + _WINDOW - 1, np.float32)
    across = np.zeros((_WINDOW, width), np.float32)  # maxima along the last rows
    is_peak = np.zeros((width + 7) // 8 * 8, np.bool_)
    eight = is_peak.view(np.uint64)
    places = np.empty(height * width, np.int32)
    count = 0
    least = np.float32(LEAST_RESPONSE)
    for row in range(-NMS_RADIUS, height - 1):
        below = row + NMS_RADIUS
        highest = across[below % _WINDOW]
        highest[:] = 0
        if below < height:
            for x in range(width):
                padded[NMS_RADIUS + x] = abs(determinant[below, x])
            for x in range(width):
                high = padded[x]
                for k in range(1, _WINDOW):
                    high = padded[x + k] if padded[x + k] > high else high
                highest[x] = high
        if row < 1:
            continue
        here = determinant[row]
        for x in range(1, width - 1):
            high = across[0, x]
            for k in range(1, _WINDOW):
                high = across[k, x] if across[k, x] > high else high
            is_peak[x] = (abs(here[x]) == high) & (high > least)
        for part in range(len(eight)):
            if eight[part]:
                for x in range(8 * part, min(8 * part + 8, width - 1)):
                    if is_peak[x]:
                        places[count] = row * width + x
                        count += 1
    pixels = np.empty((count, 2), np.int64)
    xy = np.empty((count, 2))
    for k in range(count):
        row, x = places[k] // width, places[k] % width
        middle = determinant[row, x]
        pixels[k, 0], pixels[k, 1] = row, x
        xy[k, 0] = x + _offset(determinant[row, x - 1], middle, determinant[row, x + 1])
        xy[k, 1] = row + _offset(determinant[row - 1, x], middle, determinant[row + 1, x])
    return pixels, xy


@compiled(nogil=True)
def _offset(before, middle, after):  # type: ignore[no-untyped-def]
    """Return where a parabola through the magnitudes of three pixels has its maximum."""
    before, middle = np.float64(abs(before)), np.float64(abs(middle))
    after = np.float64(abs(after))
    bend = 2 * middle - before - after
    if bend <= 0:
        return 0.0
    return min(max((after - before) / (2 * bend), -MAX_OFFSET_PX), MAX_OFFSET_PX)


@compiled(nogil=True)
def _slope(image, row, column, variance):  # type: ignore[no-untyped-def]
    """Return the squared gradient, normalised by the variance."""
    height, width = image.shape
    dx, dy = np.float32(0), np.float32(0)
    if 0 < column < width - 1:
        dx = image[row, column + 1] - image[row, column - 1]
    if 0 < row < height - 1:
        dy = image[row + 1, column] - image[row - 1, column]
    return (dx * dx + dy * dy) * (variance * np.float32(0.25))


@compiled(nogil=True)
def measure_candidates(  # type: ignore[no-untyped-def]
    first, last, smooth, determinant, variances, rings, candidates, floors, features
):
    """Compute the features, but those that `describe_candidates` adds, of some candidates.

    `rings` are (L, R, P, 2) offsets in x and y of the points of rings in each level, `candidates`
    (N, 3): level, row and column.
    """
    levels, height, width = smooth.shape
    floor, slope_floor, strength_floor = floors
    half, quarter = np.float32(0.5), np.float32(0.25)
    for n in range(first, last):
        level, row, column = candidates[n]
        own_determinant, own_smooth = determinant[level, row, column], smooth[level, row, column]
        own = math.log(abs(own_determinant) + floor)
        strength = math.sqrt(abs(own_determinant) + strength_floor)
        out = features[n]
        out[0] = (own + np.float32(9)) / np.float32(3)
        out[4] = np.sign(own_determinant)
        for k in range(4):
            near = min(max(level + k - 1, 0), levels - 1)
            image, response = smooth[near], determinant[near]
            here = image[row, column]
            xx = (image[row, column - 1] - np.float32(2) * here) + image[row, column + 1]
            yy = (image[row - 1, column] - np.float32(2) * here) + image[row + 1, column]
            bent = math.atan((xx + yy) * variances[near] / strength * half)
            out[5 + 2 * k], out[6 + 2 * k] = bent, abs(bent)
            slope = math.log(_slope(image, row, column, variances[near]) + slope_floor)
            out[13 + k] = (slope - own) * quarter
            if k != 1:
                highest = np.float32(0)
                for y in range(max(row - NMS_RADIUS, 0), min(row + NMS_RADIUS + 1, height)):
                    for x in range(max(column - NMS_RADIUS, 0), min(column + NMS_RADIUS + 1, width)):
                        highest = max(highest, abs(response[y, x]))
                there = math.log(abs(response[row, column]) + floor)
                place = k - (k > 1)
                out[1 + place] = (there - own) * half
                out[18 + place] = (math.log(highest + floor) - there) * half
        out[17] = np.float32(2) * own_smooth - np.float32(1)
        image, response, variance = smooth[level], determinant[level], variances[level]
        for k in range(rings.shape[1]):
            product, slopes, light = 1.0, 1.0, np.float32(0)
            most, least = np.float32(0), np.float32(np.inf)
            steepest, brightest, darkest = np.float32(0), np.float32(-np.inf), np.float32(np.inf)
            for point in range(rings.shape[2]):
                x = int(np.rint(column + rings[level, k, point, 0]))
                y = int(np.rint(row + rings[level, k, point, 1]))
                x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
                value = abs(response[y, x])
                product *= value + floor
                most, least = max(most, value), min(least, value)
                value = _slope(image, y, x, variance)
                slopes *= value + slope_floor
                steepest = max(steepest, value)
                value = image[y, x] - own_smooth
                light += value
                brightest, darkest = max(brightest, value), min(darkest, value)
            # The mean of logarithms is the logarithm of a product.
            count = rings.shape[2]
            at = 21 + 8 * k
            out[at] = (math.log(product) / count - own) / 2
            out[at + 1] = (math.log(most + floor) - own) * half
            out[at + 2] = (math.log(least + floor) - own) * quarter
            out[at + 3] = math.atan(light / count / strength / 2)
            out[at + 4] = math.atan(brightest / strength * half)
            out[at + 5] = math.atan(darkest / strength * half)
            out[at + 6] = (math.log(slopes) / count - own) / 4
            out[at + 7] = (math.log(steepest + slope_floor) - own) * quarter
