"""Compiled kernel of `subpixel`. Importing this module loads numba; the first call compiles it."""

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


@compiled(nogil=True, fastmath=True)
def align(  # type: ignore[no-untyped-def]
    first,
    last,
    image0,
    image1,
    pixels0,
    points1,
    affinities,
    window,
    iterations,
    convergence,
    max_shift,
    least,
    refined,
    converged,
):
    """Refine the matches `first` to `last - 1`; write `refined` and `converged`.

    The method is inverse compositional: the derivatives of the patch of the first image and the
    normal matrix are computed only once for each match. The arguments are those of
    `subpixel.align_patches`, with `window` for the (side, side) weights of a patch and `least` for
    the minimum correlation of a match that has converged.
    """
    side = window.shape[0]
    radius = side // 2
    height0, width0 = image0.shape
    height1, width1 = image1.shape
    count = side * side
    template = np.empty(count, np.float32)
    seen = np.empty(count, np.float32)
    slope = np.empty((2, count), np.float32)
    weight = window.reshape(-1)
    total = np.float32(0)
    for j in range(count):
        total += weight[j]
    for k in range(first, last):
        x0, y0 = pixels0[k, 0], pixels0[k, 1]
        refined[k, 0], refined[k, 1] = points1[k, 0], points1[k, 1]
        converged[k] = False
        if not (radius < x0 < width0 - radius - 1 and radius < y0 < height0 - radius - 1):
            continue
        mean, mean_x, mean_y = np.float32(0), np.float32(0), np.float32(0)
        j = 0
        for down in range(-radius, radius + 1):
            for across in range(-radius, radius + 1):
                y, x = y0 + down, x0 + across
                value = image0[y, x]
                sx = np.float32(0.5) * (image0[y, x + 1] - image0[y, x - 1])
                sy = np.float32(0.5) * (image0[y + 1, x] - image0[y - 1, x])
                template[j], slope[0, j], slope[1, j] = value, sx, sy
                mean += weight[j] * value
                mean_x += weight[j] * sx
                mean_y += weight[j] * sy
                j += 1
        mean, mean_x, mean_y = mean / total, mean_x / total, mean_y / total
        # Subtracting the means eliminates the offset. The gain is eliminated in the next two loops.
        tt, tx, ty = np.float32(0), np.float32(0), np.float32(0)
        for j in range(count):
            template[j] -= mean
            slope[0, j] -= mean_x
            slope[1, j] -= mean_y
            tt += weight[j] * template[j] * template[j]
            tx += weight[j] * template[j] * slope[0, j]
            ty += weight[j] * template[j] * slope[1, j]
        if tt < np.float32(1e-3) * total:
            continue
        xx, xy, yy = np.float32(0), np.float32(0), np.float32(0)
        for j in range(count):
            slope[0, j] -= tx / tt * template[j]
            slope[1, j] -= ty / tt * template[j]
            xx += weight[j] * slope[0, j] * slope[0, j]
            xy += weight[j] * slope[0, j] * slope[1, j]
            yy += weight[j] * slope[1, j] * slope[1, j]
        determinant = xx * yy - xy * xy
        if determinant <= np.float32(1e-6) * (xx + yy) * (xx + yy) or xx + yy <= 0:
            continue
        affinity = affinities[k]
        a, b, c, d = affinity[0, 0], affinity[0, 1], affinity[1, 0], affinity[1, 1]
        spread_x = radius * (abs(a) + abs(b)) + 2
        spread_y = radius * (abs(c) + abs(d)) + 2
        most_x, most_y = width1 - 1 - spread_x, height1 - 1 - spread_y
        x1, y1 = points1[k, 0], points1[k, 1]
        for _ in range(iterations):
            if x1 < spread_x or y1 < spread_y or x1 > most_x or y1 > most_y:
                break
            mean = np.float32(0)
            j = 0
            for down in range(-radius, radius + 1):
                for across in range(-radius, radius + 1):
                    value = _cubic(image1, x1 + a * across + b * down, y1 + c * across + d * down)
                    seen[j] = value
                    mean += weight[j] * value
                    j += 1
            mean /= total
            ts, ss, ex, ey = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for j in range(count):
                value = weight[j] * (seen[j] - mean)
                ts += value * template[j]
                ss += value * (seen[j] - mean)
                ex += value * slope[0, j]
                ey += value * slope[1, j]
            gain = ts / tt
            correlation = ts / np.sqrt(max(ss * tt, np.float32(1e-12)))
            if gain <= 0:
                break
            # Slopes and template are orthogonal, so `ex` and `ey` depend only on gain times shift.
            step_x = (yy * ex - xy * ey) / determinant / gain
            step_y = (xx * ey - xy * ex) / determinant / gain
            x1 -= a * step_x + b * step_y
            y1 -= c * step_x + d * step_y
            gone_x, gone_y = x1 - points1[k, 0], y1 - points1[k, 1]
            if not gone_x * gone_x + gone_y * gone_y <= max_shift * max_shift:
                break
            if step_x * step_x + step_y * step_y < convergence * convergence:
                if correlation >= least:
                    converged[k] = True
                    refined[k, 0], refined[k, 1] = x1, y1
                break
