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
def differentiate(smooth, variance, determinant):  # type: ignore[no-untyped-def]
    """Compute the determinant of the scale-normalised Hessian of a smoothed (H, W) float32 image.

    `variance` is the variance of the Gaussian that smoothed the image. Derivatives are central
    differences; the image is mirrored at its border. The result is written into `determinant`.
    """
    height, width = smooth.shape
    scale = variance * variance
    for row in range(height):
        here, out = smooth[row], determinant[row]
        above = smooth[row - 1 if row else min(1, height - 1)]
        below = smooth[row + 1 if row + 1 < height else max(height - 2, 0)]
        above1, above2, here1, here2 = above[1:], above[2:], here[1:], here[2:]
        below1, below2, inner = below[1:], below[2:], out[1:]
        for x in range(width - 2):
            # Subtracting in this order keeps values, and therefore rounding errors, small.
            double = np.float32(2) * here1[x]
            xx, yy = (here[x] - double) + here2[x], (above1[x] - double) + below1[x]
            xy = (below2[x] - below[x]) - (above2[x] - above[x])
            inner[x] = (xx * yy - xy * xy * np.float32(1 / 16)) * scale
        for x, beside in ((0, min(1, width - 1)), (width - 1, max(width - 2, 0))):
            double = np.float32(2) * here[x]
            xx, yy = (here[beside] - double) + here[beside], (above[x] - double) + below[x]
            out[x] = xx * yy * scale


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
    first, last, shape, smooth, determinant, variances, rings, candidates, floors, features
):
    """Write the features of the candidates `first` to `last` (exclusive) into `features`, (N, F).

    `describe_candidates` adds rank, level and the mean grey value. `smooth` and `determinant` are
    flattened maps of `shape` (L, H, W). `rings` comes from `ring_offsets`. The columns of
    `candidates`, (N, 3), are level, row and column.
    """
    levels, height, width = shape
    floor, slope_floor, strength_floor = floors
    half, quarter = np.float32(0.5), np.float32(0.25)
    steps, values = np.empty((3, _POINTS), np.int64), np.empty((3, _POINTS), np.float32)
    places, right, down = steps[0], steps[1], steps[2]
    response, slope, light = values[0], values[1], values[2]
    # `logs`: |det Hessian| at the candidate's scale and three others, maxima near the candidate at
    # those three, squared gradients at all four, and ring values. `bent`: inputs of arctangents.
    logs, bent = np.empty(11 + 7 * RINGS, np.float32), np.empty(4 + 3 * RINGS, np.float32)
    for n in range(first, last):
        level, row, column = candidates[n, 0], candidates[n, 1], candidates[n, 2]
        pixel, start = row * width + column, level * height * width
        own_determinant, own_smooth = determinant[start + pixel], smooth[start + pixel]
        strength = math.sqrt(abs(own_determinant) + strength_floor)
        logs[0] = abs(own_determinant) + floor
        for k in range(4):
            near = min(max(level + k - 1, 0), levels - 1)
            here = near * height * width + pixel
            double = np.float32(2) * smooth[here]
            xx = (smooth[here - 1] - double) + smooth[here + 1]
            yy = (smooth[here - width] - double) + smooth[here + width]
            bent[k] = (xx + yy) * variances[near] / strength * half
            dx = smooth[here + 1] - smooth[here - 1]
            dy = smooth[here + width] - smooth[here - width]
            logs[7 + k] = (dx * dx + dy * dy) * (variances[near] * quarter) + slope_floor
            if k != 1:
                highest = np.float32(0)
                for j in range(-2, 3):
                    y = min(max(row + j, 0), height - 1)
                    for i in range(-2, 3):
                        x = min(max(column + i, 0), width - 1)
                        value = abs(determinant[(near * height + y) * width + x])
                        highest = value if value > highest else highest
                logs[1 + k - (k > 1)] = abs(determinant[here]) + floor
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
            response[k] = abs(determinant[here])
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
            bent[4 + k] = total / np.float32(RING_POINTS) / strength * half
            bent[4 + RINGS + k] = brightest / strength * half
            bent[4 + 2 * RINGS + k] = darkest / strength * half
        # One logarithm of the product of 4 values replaces 4; the product is at least 1e-28, not 0.
        for k in range(2 * RINGS):
            product, slopes = np.float32(1), np.float32(1)
            for j in range(k, _POINTS, 2 * RINGS):
                product *= response[j] + floor
                slopes *= slope[j] + slope_floor
            logs[11 + 3 * RINGS + k], logs[11 + 5 * RINGS + k] = product, slopes
        for k in range(len(logs)):
            logs[k] = math.log(logs[k])
        _arctangents(bent)
        own = logs[0]
        features[n, 0] = (own + np.float32(9)) / np.float32(3)
        features[n, 4] = np.sign(own_determinant)
        features[n, 17] = np.float32(2) * own_smooth
        for k in range(3):
            features[n, 1 + k] = (logs[1 + k] - own) * half
            features[n, 18 + k] = (logs[4 + k] - logs[1 + k]) * half
        for k in range(4):
            features[n, 5 + 2 * k], features[n, 6 + 2 * k] = bent[k], abs(bent[k])
            features[n, 13 + k] = (logs[7 + k] - own) * quarter
        for k in range(RINGS):
            at, of_ring = 21 + 8 * k, logs[11 + k :: RINGS]
            features[n, at] = ((of_ring[3] + of_ring[4]) / np.float32(RING_POINTS) - own) * half
            features[n, at + 1] = (of_ring[0] - own) * half
            features[n, at + 2] = (of_ring[1] - own) * quarter
            for j in range(3):
                features[n, at + 3 + j] = bent[4 + j * RINGS + k]
            mean = (of_ring[5] + of_ring[6]) / np.float32(RING_POINTS)
            features[n, at + 6] = (mean - own) * quarter
            features[n, at + 7] = (of_ring[2] - own) * quarter
