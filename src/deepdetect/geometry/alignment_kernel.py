"""Compiled kernel of `alignment`. Importing this module loads numba; the first call compiles it."""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled


@compiled(nogil=True, fastmath=True, inline="always")
def _cubic(image, x, y):  # type: ignore[no-untyped-def]
    """Interpolate (Keys's cubic, a = -1/2) at (x, y), at least 2 pixels from the image border."""
    column, row = np.int64(np.floor(x)), np.int64(np.floor(y))
    u, v = np.float32(x - column), np.float32(y - row)
    a0 = ((np.float32(-0.5) * u + np.float32(1.0)) * u - np.float32(0.5)) * u
    a1 = (np.float32(1.5) * u - np.float32(2.5)) * u * u + np.float32(1.0)
    a2 = ((np.float32(-1.5) * u + np.float32(2.0)) * u + np.float32(0.5)) * u
    a3 = (np.float32(0.5) * u - np.float32(0.5)) * u * u
    b0 = ((np.float32(-0.5) * v + np.float32(1.0)) * v - np.float32(0.5)) * v
    b1 = (np.float32(1.5) * v - np.float32(2.5)) * v * v + np.float32(1.0)
    b2 = ((np.float32(-1.5) * v + np.float32(2.0)) * v + np.float32(0.5)) * v
    b3 = (np.float32(0.5) * v - np.float32(0.5)) * v * v
    top, one, two, low = image[row - 1], image[row], image[row + 1], image[row + 2]
    c = column
    return (
        b0 * (a0 * top[c - 1] + a1 * top[c] + a2 * top[c + 1] + a3 * top[c + 2])
        + b1 * (a0 * one[c - 1] + a1 * one[c] + a2 * one[c + 1] + a3 * one[c + 2])
        + b2 * (a0 * two[c - 1] + a1 * two[c] + a2 * two[c + 1] + a3 * two[c + 2])
        + b3 * (a0 * low[c - 1] + a1 * low[c] + a2 * low[c + 1] + a3 * low[c + 2])
    )


@compiled(nogil=True, fastmath=True, inline="always")
def _linear(image, x, y):  # type: ignore[no-untyped-def]
    column, row = np.int64(x), np.int64(y)
    u, v = np.float32(x - column), np.float32(y - row)
    top, low = image[row], image[row + 1]
    above = top[column] + u * (top[column + 1] - top[column])
    return above + v * (low[column] + u * (low[column + 1] - low[column]) - above)


@compiled(nogil=True, fastmath=True)
def _read(image, x, y, a, b, c, d, radius, cubic, values):  # type: ignore[no-untyped-def]
    """Write the pixels of a patch around (x, y), warped by the affinity ((a, b), (c, d))."""
    j = 0
    for down in range(-radius, radius + 1):
        for across in range(-radius, radius + 1):
            right, below = x + a * across + b * down, y + c * across + d * down
            values[j] = _cubic(image, right, below) if cubic else _linear(image, right, below)
            j += 1


@compiled(nogil=True, fastmath=True)
def _inverted(matrix, inverse, size):  # type: ignore[no-untyped-def]
    """Write the inverse of a positive definite `matrix` to `inverse`; the matrix is destroyed."""
    for row in range(size):
        for column in range(size):
            inverse[row, column] = 1.0 if row == column else 0.0
    for pivot in range(size):
        factor = 1 / matrix[pivot, pivot]
        for column in range(size):
            matrix[pivot, column] *= factor
            inverse[pivot, column] *= factor
        for row in range(size):
            if row != pivot:
                factor = matrix[row, pivot]
                for column in range(size):
                    matrix[row, column] -= factor * matrix[pivot, column]
                    inverse[row, column] -= factor * inverse[pivot, column]


@compiled(nogil=True, fastmath=True)
def _prepare(image, x0, y0, weight, radius, free, ridge, cubic, ring, template, slope, inverse):  # type: ignore[no-untyped-def]
    """Write a patch's derivatives, the inverse of their normal matrix, and the patch less its mean.

    Returns the variance of the patch; 0 if the patch is flat or shows only parallel edges.
    """
    side = 2 * radius + 1
    count, wide = side * side, side + 2
    normal = np.empty((6, 6))
    _read(image, x0, y0, 1.0, 0.0, 0.0, 1.0, radius + 1, cubic, ring)
    mean, j = np.float32(0), 0
    for row in range(1, side + 1):
        for column in range(1, side + 1):
            at = row * wide + column
            template[j] = ring[at]
            mean += weight[j] * ring[at]
            slope[0, j] = np.float32(0.5) * (ring[at + 1] - ring[at - 1])
            slope[1, j] = np.float32(0.5) * (ring[at + wide] - ring[at - wide])
            if free == 6:
                across, down = np.float32(column - 1 - radius), np.float32(row - 1 - radius)
                slope[2, j], slope[3, j] = slope[0, j] * across, slope[0, j] * down
                slope[4, j], slope[5, j] = slope[1, j] * across, slope[1, j] * down
            j += 1
    # Subtracting the means eliminates the brightness offset. The loop below eliminates the gain.
    tt = np.float32(0)
    for j in range(count):
        template[j] -= mean
        tt += weight[j] * template[j] * template[j]
    if tt < np.float32(1e-3):
        return np.float32(0)
    for one in range(free):
        mean, gain = np.float32(0), np.float32(0)
        for j in range(count):
            mean += weight[j] * slope[one, j]
        for j in range(count):
            slope[one, j] -= mean
            gain += weight[j] * slope[one, j] * template[j]
        for j in range(count):
            slope[one, j] -= gain / tt * template[j]
        for other in range(one + 1):
            total = np.float32(0)
            for j in range(count):
                total += weight[j] * slope[one, j] * slope[other, j]
            normal[one, other] = normal[other, one] = total
    trace = normal[0, 0] + normal[1, 1]
    round_off = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2 <= 1e-6 * trace**2
    if round_off or trace <= 0:
        return np.float32(0)
    for one in range(free):
        normal[one, one] += ridge * trace * (1.0 if one < 2 else radius**2 / 4)
    _inverted(normal, inverse, free)
    return tt


@compiled(nogil=True, fastmath=True)
def align(  # type: ignore[no-untyped-def]
    first,
    last,
    image0,
    image1,
    points0,
    points1,
    affinities,
    window,
    free,
    ridge,
    cubic,
    iterations,
    convergence,
    max_shift,
    least,
    aligned,
    correlations,
    covariances,
):
    """Align the patches `first` to `last - 1` of the first image to the second.

    The method is inverse compositional: the derivatives of the patch of the first image and the
    normal matrix are computed only once for each match. With `free` = 2, only the position is
    estimated, with 6 also the affinity, in place. `aligned`, `correlations` and `covariances` are
    written; the correlation of a patch that does not converge is 0. The caller divides the
    covariance (xx, xy, yy) by the number of independent pixels in a patch. See
    `alignment.align_patches` for the other arguments.
    """
    side = window.shape[0]
    radius = side // 2
    reach = radius + 3 if cubic else radius + 2
    height0, width0 = image0.shape
    height1, width1 = image1.shape
    count, wide = side * side, side + 2
    template, seen = np.empty(count, np.float32), np.empty(count, np.float32)
    ring, slope = np.empty(wide * wide, np.float32), np.empty((6, count), np.float32)
    inverse, step = np.empty((6, 6)), np.empty(6)
    weight = window.reshape(-1) / window.sum()
    for k in range(first, last):
        x0, y0 = points0[k, 0], points0[k, 1]
        aligned[k, 0], aligned[k, 1] = points1[k, 0], points1[k, 1]
        correlations[k] = 0
        if not (reach <= x0 <= width0 - 1 - reach and reach <= y0 <= height0 - 1 - reach):
            continue
        tt = _prepare(
            image0, x0, y0, weight, radius, free, ridge, cubic, ring, template, slope, inverse
        )
        if tt == 0:
            continue
        a, b, c, d = (
            affinities[k, 0, 0],
            affinities[k, 0, 1],
            affinities[k, 1, 0],
            affinities[k, 1, 1],
        )
        x1, y1 = points1[k, 0], points1[k, 1]
        for _ in range(iterations):
            spread_x = radius * (abs(a) + abs(b)) + 2
            spread_y = radius * (abs(c) + abs(d)) + 2
            across, down = width1 - 1 - spread_x, height1 - 1 - spread_y
            if not (spread_x <= x1 <= across and spread_y <= y1 <= down):
                break
            _read(image1, x1, y1, a, b, c, d, radius, cubic, seen)
            mean, ts, ss = np.float32(0), np.float32(0), np.float32(0)
            for j in range(count):
                mean += weight[j] * seen[j]
            for j in range(count):
                value = seen[j] - mean
                ts += weight[j] * value * template[j]
                ss += weight[j] * value * value
            if ts <= 0:
                break
            gain = ts / tt
            # `slope` is orthogonal to the first patch, so `error` depends only on gain * shift.
            for one in range(free):
                step[one] = 0
            for one in range(free):
                error = np.float32(0)
                for j in range(count):
                    error += weight[j] * seen[j] * slope[one, j]
                for other in range(free):
                    step[other] += inverse[other, one] * error / gain
            if free == 6:
                aa, bb, cc, dd = 1 + step[2], step[3], step[4], 1 + step[5]
                growth = aa * dd - bb * cc
                if growth < 0.25:
                    break
                a, b = (a * dd - b * cc) / growth, (b * aa - a * bb) / growth
                c, d = (c * dd - d * cc) / growth, (d * aa - c * bb) / growth
            x1 -= a * step[0] + b * step[1]
            y1 -= c * step[0] + d * step[1]
            gone_x, gone_y = x1 - points1[k, 0], y1 - points1[k, 1]
            if not gone_x * gone_x + gone_y * gone_y <= max_shift * max_shift:
                break
            if step[0] * step[0] + step[1] * step[1] < convergence * convergence:
                correlation = ts / np.sqrt(max(ss * tt, np.float32(1e-12)))
                if correlation >= least:
                    aligned[k, 0], aligned[k, 1], correlations[k] = x1, y1, correlation
                    affinities[k, 0, 0], affinities[k, 0, 1] = a, b
                    affinities[k, 1, 0], affinities[k, 1, 1] = c, d
                    noise = max(ss - ts * gain, np.float32(0)) / (gain * gain)
                    xx, xy, yy = noise * inverse[0, 0], noise * inverse[0, 1], noise * inverse[1, 1]
                    covariances[k, 0] = a * a * xx + 2 * a * b * xy + b * b * yy
                    covariances[k, 1] = a * c * xx + (a * d + b * c) * xy + b * d * yy
                    covariances[k, 2] = c * c * xx + 2 * c * d * xy + d * d * yy
                break
