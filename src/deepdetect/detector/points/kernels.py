"""Compiled functions of `PointDetector`: the Hessian, and the features of candidate keypoints.

Inner loops run over adjacent memory, so that the compiler vectorises them.
"""

from __future__ import annotations

import math

import numpy as np

from ..._shared.kernels import compiled

RINGS, RING_POINTS = 4, 8
_POINTS = RINGS * RING_POINTS


@compiled(nogil=True, error_model="numpy")
def differentiate(smooth, variance, response):  # type: ignore[no-untyped-def]
    """Compute |det Hessian|, scale-normalised, of a smoothed (H, W) float32 image.

    `variance` is the variance of the Gaussian that smoothed the image. Derivatives are central
    differences; the image is mirrored at its border. The result is written into `response`.
    """
    height, width = smooth.shape
    scale = variance * variance
    for row in range(height):
        here, out = smooth[row], response[row]
        above = smooth[row - 1 if row else min(1, height - 1)]
        below = smooth[row + 1 if row + 1 < height else max(height - 2, 0)]
        above1, above2, here1, here2 = above[1:], above[2:], here[1:], here[2:]
        below1, below2, inner = below[1:], below[2:], out[1:]
        for x in range(width - 2):
            # Subtracting in this order keeps values, and therefore rounding errors, small.
            double = np.float32(2) * here1[x]
            xx, yy = (here[x] - double) + here2[x], (above1[x] - double) + below1[x]
            xy = (below2[x] - below[x]) - (above2[x] - above[x])
            inner[x] = abs(xx * yy - xy * xy * np.float32(1 / 16)) * scale
        for x, beside in ((0, min(1, width - 1)), (width - 1, max(width - 2, 0))):
            double = np.float32(2) * here[x]
            xx, yy = (here[beside] - double) + here[beside], (above[x] - double) + below[x]
            out[x] = abs(xx * yy) * scale


@compiled(nogil=True, error_model="numpy")
def mark_peaks(response, radius, least, peak):  # type: ignore[no-untyped-def]
    """Mark, in `peak`, the (H, W) values above `least` that are maxima within `radius` pixels.

    The outermost pixels are not marked.
    """
    height, width = response.shape
    rows = 2 * radius + 1
    across, highest = np.zeros((rows, width), np.float32), np.empty(width, np.float32)
    for row in range(height + radius):
        out = across[row % rows]
        if row < height:
            out[:] = response[row]
            for step in range(1, radius + 1):
                for x in range(width - step):
                    out[x] = max(out[x], response[row, x + step])
                for x in range(step, width):
                    out[x] = max(out[x], response[row, x - step])
        else:
            out[:] = 0
        middle = row - radius
        if middle < 1 or middle >= height - 1:
            continue
        highest[:] = across[0]
        for other in range(1, rows):
            for x in range(width):
                highest[x] = max(highest[x], across[other, x])
        own, marks = response[middle], peak[middle]
        for x in range(1, width - 1):
            marks[x] = (own[x] == highest[x]) & (own[x] > least)


@compiled(nogil=True, error_model="numpy")
def refine_peaks(pixels, responses, layout, octaves, most, xy):  # type: ignore[no-untyped-def]
    """Write the image positions of maxima, given by level, row and column, into `xy`, (N, 2).

    A paraboloid through the 3x3 pixels moves each by up to `most` pixels in x and in y.
    """
    near = np.empty((3, 3))
    for n in range(len(pixels)):
        level, row, column = pixels[n, 0], pixels[n, 1], pixels[n, 2]
        start, _, width = layout[level]
        here = start + row * width + column
        for j in range(3):
            for i in range(3):
                near[j, i] = responses[here + (j - 1) * width + i - 1]
        dx, dy = (near[1, 2] - near[1, 0]) / 2, (near[2, 1] - near[0, 1]) / 2
        xx = near[1, 0] - 2 * near[1, 1] + near[1, 2]
        yy = near[0, 1] - 2 * near[1, 1] + near[2, 1]
        mixed = (near[0, 0] + near[2, 2] - near[0, 2] - near[2, 0]) / 4
        bend = xx * yy - mixed * mixed
        if not (bend > 0 and xx < 0):
            mixed, bend = 0.0, xx * yy
        across = (mixed * dy - yy * dx) / bend if bend > 0 else 0.0
        down = (mixed * dx - xx * dy) / bend if bend > 0 else 0.0
        scale = 1 << octaves[level]
        xy[n, 0] = (column + max(min(across, most), -most)) * scale
        xy[n, 1] = (row + max(min(down, most), -most)) * scale


@compiled(nogil=True, error_model="numpy")
def _logarithms(values, bits, exponents):  # type: ignore[no-untyped-def]
    """Replace positive float32 numbers by their logarithms, by Cephes's series, which vectorises.

    `bits` is a view of `values` as int32. `exponents` is int32 memory of the same length.
    """
    for k in range(len(bits)):
        # A number is m times 2^exponent, with m between sqrt(1/2) and sqrt(2).
        exponents[k] = (bits[k] - np.int32(0x3F3504F3)) >> np.int32(23)
        bits[k] -= exponents[k] << np.int32(23)
    for k in range(len(values)):
        x, power = values[k] - np.float32(1), np.float32(exponents[k])
        series = np.float32(7.0376836292e-2) * x - np.float32(1.1514610310e-1)
        series = series * x + np.float32(1.1676998740e-1)
        series = series * x - np.float32(1.2420140846e-1)
        series = series * x + np.float32(1.4249322787e-1)
        series = series * x - np.float32(1.6668057665e-1)
        series = series * x + np.float32(2.0000714765e-1)
        series = series * x - np.float32(2.4999993993e-1)
        series = series * x + np.float32(3.3333331174e-1)
        square = x * x
        tail = series * x * square - power * np.float32(2.12194440e-4) - square * np.float32(0.5)
        values[k] = x + tail + power * np.float32(0.693359375)


@compiled(nogil=True, error_model="numpy")
def _arctangents(values):  # type: ignore[no-untyped-def]
    """Replace float32 numbers by their arctangents, by Cephes's series, which vectorises."""
    for k in range(len(values)):
        x = abs(values[k])
        steep, medium = x > np.float32(2.41421356), x > np.float32(0.41421356)
        angle = np.float32(np.pi / 4) if medium else np.float32(0)
        angle = np.float32(np.pi / 2) if steep else angle
        above = x - np.float32(1) if medium else x
        below = x + np.float32(1) if medium else np.float32(1)
        t = (np.float32(-1) if steep else above) / (x if steep else below)
        square = t * t
        series = np.float32(8.05374449538e-2) * square - np.float32(1.38776856032e-1)
        series = series * square + np.float32(1.99777106478e-1)
        series = series * square - np.float32(3.33329491539e-1)
        angle += series * square * t + t
        values[k] = angle if values[k] >= 0 else -angle


@compiled(nogil=True, error_model="numpy")
def measure_candidates(  # type: ignore[no-untyped-def]
    first, last, smooth, responses, layout, octaves, variances, rings, candidates, floors, features
):
    """Write the features of the candidates `first` to `last` (exclusive) into `features`, (N, F).

    `describe_candidates` adds rank, level and the mean grey value. `smooth`, `responses` and
    `layout` are those of a `ScaleSpace`. `rings` comes from `ring_offsets`. The columns of
    `candidates`, (N, 3), are level, row and column.
    """
    floor, slope_floor, strength_floor = floors
    half_, quarter = np.float32(0.5), np.float32(0.25)
    steps, values = np.empty((3, _POINTS), np.int64), np.empty((3, _POINTS), np.float32)
    places, right, down = steps[0], steps[1], steps[2]
    response, slope, light = values[0], values[1], values[2]
    # `logs`: |det Hessian| at the candidate's scale and three others, maxima near the candidate at
    # those three, squared gradients at all four, and ring values. `bent`: inputs of arctangents.
    logs, bent = np.empty(11 + 7 * RINGS, np.float32), np.empty(4 + 3 * RINGS, np.float32)
    bits, exponents = logs.view(np.int32), np.empty(len(logs), np.int32)
    for n in range(first, last):
        level, row, column = candidates[n, 0], candidates[n, 1], candidates[n, 2]
        start, height, width = layout[level]
        pixel = row * width + column
        own_response, own_smooth = responses[start + pixel], smooth[start + pixel]
        strength = math.sqrt(own_response + strength_floor)
        logs[0] = own_response + floor
        sign = np.float32(0)
        for k in range(4):
            near = level + k - 1
            begin, high, wide = layout[near]
            # The nearest pixel of the other level. At its border, the image is mirrored.
            half, octave = 1 << octaves[near] >> 1, octaves[near]
            y = min(((row << octaves[level]) + half) >> octave, high - 1)
            x = min(((column << octaves[level]) + half) >> octave, wide - 1)
            here = begin + y * wide + x
            left, right1 = here - 1 if x else here + min(1, wide - 1), here + 1
            right1 = right1 if x + 1 < wide else here - min(1, wide - 1)
            above, below = here - wide if y else here + wide * min(1, high - 1), here + wide
            below = below if y + 1 < high else here - wide * min(1, high - 1)
            double = np.float32(2) * smooth[here]
            xx = (smooth[left] - double) + smooth[right1]
            yy = (smooth[above] - double) + smooth[below]
            bent[k] = (xx + yy) * variances[near] / strength * half_
            dx = smooth[right1] - smooth[left] if 0 < x < wide - 1 else np.float32(0)
            dy = smooth[below] - smooth[above] if 0 < y < high - 1 else np.float32(0)
            logs[7 + k] = (dx * dx + dy * dy) * (variances[near] * quarter) + slope_floor
            if k == 1:
                xy = (smooth[below + 1] - smooth[below - 1]) - (
                    smooth[above + 1] - smooth[above - 1]
                )
                sign = np.sign(xx * yy - xy * xy * np.float32(1 / 16))
            else:
                highest = np.float32(0)
                for j in range(max(y - 2, 0), min(y + 3, high)):
                    for i in range(
                        begin + j * wide + max(x - 2, 0), begin + j * wide + min(x + 3, wide)
                    ):
                        highest = max(highest, responses[i])
                logs[1 + k - (k > 1)] = responses[here] + floor
                logs[4 + k - (k > 1)] = highest + floor
        for k in range(_POINTS):
            x = column + rings[0, level, column & 1, k]
            y = row + rings[1, level, row & 1, k]
            x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
            places[k] = start + y * width + x
            # On the image border, the gradient across the border is 0.
            right[k] = 1 if 0 < x < width - 1 else 0
            down[k] = width if 0 < y < height - 1 else 0
        for k in range(_POINTS):
            here = places[k]
            dx = smooth[here + right[k]] - smooth[here - right[k]]
            dy = smooth[here + down[k]] - smooth[here - down[k]]
            response[k] = responses[here]
            slope[k] = (dx * dx + dy * dy) * (variances[level] * quarter)
            light[k] = smooth[here] - own_smooth
        for k in range(RINGS):
            most, least, steepest = response[k], response[k], slope[k]
            total, brightest, darkest = light[k], light[k], light[k]
            for j in range(k + RINGS, _POINTS, RINGS):
                most = response[j] if response[j] > most else most
                least = response[j] if response[j] < least else least
                steepest = slope[j] if slope[j] > steepest else steepest
                total += light[j]
                brightest = light[j] if light[j] > brightest else brightest
                darkest = light[j] if light[j] < darkest else darkest
            logs[11 + k], logs[11 + RINGS + k] = most + floor, least + floor
            logs[11 + 2 * RINGS + k] = steepest + slope_floor
            bent[4 + k] = total / np.float32(RING_POINTS) / strength * half_
            bent[4 + RINGS + k] = brightest / strength * half_
            bent[4 + 2 * RINGS + k] = darkest / strength * half_
        # One logarithm of the product of 4 values replaces 4; the product is at least 1e-28, not 0.
        for k in range(2 * RINGS):
            product, slopes = np.float32(1), np.float32(1)
            for j in range(k, _POINTS, 2 * RINGS):
                product *= response[j] + floor
                slopes *= slope[j] + slope_floor
            logs[11 + 3 * RINGS + k], logs[11 + 5 * RINGS + k] = product, slopes
        _logarithms(logs, bits, exponents)
        _arctangents(bent)
        own = logs[0]
        features[n, 0] = (own + np.float32(9)) / np.float32(3)
        features[n, 4] = sign
        features[n, 17] = np.float32(2) * own_smooth
        for k in range(3):
            features[n, 1 + k] = (logs[1 + k] - own) * half_
            features[n, 18 + k] = (logs[4 + k] - logs[1 + k]) * half_
        for k in range(4):
            features[n, 5 + 2 * k], features[n, 6 + 2 * k] = bent[k], abs(bent[k])
            features[n, 13 + k] = (logs[7 + k] - own) * quarter
        for k in range(RINGS):
            at, of_ring = 21 + 8 * k, logs[11 + k :: RINGS]
            features[n, at] = ((of_ring[3] + of_ring[4]) / np.float32(RING_POINTS) - own) * half_
            features[n, at + 1] = (of_ring[0] - own) * half_
            features[n, at + 2] = (of_ring[1] - own) * quarter
            for j in range(3):
                features[n, at + 3 + j] = bent[4 + j * RINGS + k]
            mean = (of_ring[5] + of_ring[6]) / np.float32(RING_POINTS)
            features[n, at + 6] = (mean - own) * quarter
            features[n, at + 7] = (of_ring[2] - own) * quarter
