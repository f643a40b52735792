"""Compiled kernels for dense points. Importing this module loads numba; first calls compile.

Each kernel processes the rows `first` to `last - 1` of a reference image. Neighbours are other
images of the scene. The surface around a pixel is modelled as a plane: its inverse depth w is
linear in the pixel position. The pixel (x, y) projects to A (x, y, 1) + w b, in homogeneous pixels
of a neighbour. A (3, 3) and b (3,) follow from the two cameras.
"""

from __future__ import annotations

import math

import numpy as np

from .._shared.kernels import compiled
from ..matching.stereo.kernels import count_bits

HIDDEN = np.uint64(1) << np.uint64(63)
"""A pixel's census transform has 62 bits. Bit 63 marks pixels that the neighbour does not show."""

MIN_TEXTURE = np.float32(0.18)
"""A window has texture if the variance of its gradients along the epipolar line exceeds this
multiple of the noise's variance. Skies with JPEG artefacts have less, weathered stone has more."""

MIN_GAIN = np.float32(0.2)
"""A window's shift is divided by its contrast relative to the matching window of a neighbour.
Ratios below `MIN_GAIN` are raised to `MIN_GAIN`, so that the shift does not become too large."""


@compiled(nogil=True)
def _two_best(y, census, neighbours, columns, rows, hidden_cost, line):  # type: ignore[no-untyped-def]
    """Write to `line` (D, W) sums of the two least Hamming distances to neighbours, for row y."""
    count, width = line.shape
    least, second = np.empty((2, width), np.uint8)
    for d in range(count):
        least[:] = 255
        second[:] = 255
        for k in range(len(neighbours)):
            words, at = neighbours[k, rows[k, d, y]], columns[k, d]
            for x in range(width):
                word = words[at[x]]
                bits = np.uint8(count_bits(word ^ census[y, x]))
                cost = hidden_cost if word >> np.uint64(63) else bits
                second[x] = min(second[x], max(least[x], cost))
                least[x] = min(least[x], cost)
        for x in range(width):
            line[d, x] = least[x] + second[x]


@compiled(nogil=True)
def cost_rows(first, last, census, neighbours, columns, rows, hidden_cost, cost):  # type: ignore[no-untyped-def]
    """Write the matching cost of each pixel at each of D inverse depths, (H, W, D) uint8.

    A cost is the sum, over 3 x 3 pixels, of the Hamming distances to the two neighbours that agree
    best, divided by 8. `neighbours` (K, H', W') are censuses of warped images. At the inverse depth
    with index d, pixel (x, y) is at `columns[k, d, x]` and `rows[k, d, y]` of neighbour k.
    """
    height, width, count = cost.shape
    line = np.empty((count, width), np.uint8)
    sums = np.empty((3, count, width), np.uint16)
    done = first - 2
    for y in range(first, last):
        for row in range(max(y - 1, done + 1), y + 2):
            at = min(max(row, 0), height - 1)
            _two_best(at, census, neighbours, columns, rows, hidden_cost, line)
            for d in range(count):
                here, out = line[d], sums[row % 3, d]
                out[0] = np.uint16(2 * here[0]) + np.uint16(here[1])
                out[width - 1] = np.uint16(2 * here[width - 1]) + np.uint16(here[width - 2])
                for x in range(1, width - 1):
                    out[x] = np.uint16(here[x - 1]) + np.uint16(here[x]) + np.uint16(here[x + 1])
            done = row
        for d in range(count):
            above, here, below = sums[(y + 2) % 3, d], sums[y % 3, d], sums[(y + 1) % 3, d]
            for x in range(width):
                cost[y, x, d] = np.uint8((above[x] + here[x] + below[x]) >> np.uint16(3))


@compiled(nogil=True)
def choose_rows(first, last, total, out):  # type: ignore[no-untyped-def]
    """Write each pixel's index of least cost, refined by a parabola, to `out`, (H, W) float32."""
    count = total.shape[2]
    for y in range(first, last):
        for x in range(total.shape[1]):
            sums = total[y, x]
            at, least = 0, sums[0]
            for d in range(1, count):
                if sums[d] < least:
                    at, least = d, sums[d]
            rest = 0.0
            if 0 < at < count - 1:
                before, after = float(sums[at - 1]), float(sums[at + 1])
                bend = before + after - 2 * float(least)
                rest = 0.5 * (before - after) / bend if bend > 0 else 0.0
            out[y, x] = at + rest


@compiled(nogil=True)
def fit_rows(first, last, planes, weights, radius, tolerance, min_pixels, out):  # type: ignore[no-untyped-def]
    """Fit a plane around each pixel to the inverse depths within `tolerance` of its current plane.

    `planes` (H, W, 3) float32 hold, per pixel, the inverse depth (NaN if unknown) and its change
    per pixel to the right and down. `weights` (H, W) weight the pixels in the fit. If fewer than
    `min_pixels` inverse depths are within the tolerance, the new plane is NaN.
    """
    height, width = planes.shape[:2]
    for y in range(first, last):
        for x in range(width):
            w, right, down = planes[y, x]
            n = si = sj = sii = sij = sjj = sv = siv = sjv = 0.0
            pixels = 0
            for j in range(max(-radius, -y), min(radius, height - 1 - y) + 1):
                for i in range(max(-radius, -x), min(radius, width - 1 - x) + 1):
                    rest = planes[y + j, x + i, 0] - w - i * right - j * down
                    if abs(rest) <= tolerance:
                        weight = float(weights[y + j, x + i])
                        pixels += 1
                        n += weight
                        si += weight * i
                        sj += weight * j
                        sii += weight * i * i
                        sij += weight * i * j
                        sjj += weight * j * j
                        rest *= weight
                        sv += rest
                        siv += i * rest
                        sjv += j * rest
            if pixels < min_pixels:
                out[y, x] = np.nan
                continue
            a, b, c = sii - si * si / n, sij - si * sj / n, sjj - sj * sj / n
            e, f = siv - si * sv / n, sjv - sj * sv / n
            area = a * c - b * b
            more_right = more_down = 0.0
            if area > n:  # else the pixels lie on a line: keep the slopes
                more_right, more_down = (e * c - f * b) / area, (f * a - e * b) / area
            out[y, x, 0] = w + (sv - more_right * si - more_down * sj) / n
            out[y, x, 1] = right + more_right
            out[y, x, 2] = down + more_down


@compiled(nogil=True, inline="always")
def _project(m, x, y, w):  # type: ignore[no-untyped-def]
    """Project a pixel to a neighbour; return x, y and (depth in the neighbour / depth here)."""
    z = m[2, 0] * x + m[2, 1] * y + m[2, 2] + w * m[2, 3]
    across = m[0, 0] * x + m[0, 1] * y + m[0, 2] + w * m[0, 3]
    down = m[1, 0] * x + m[1, 1] * y + m[1, 2] + w * m[1, 3]
    return across / z, down / z, z


@compiled(nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"})
def _compare(gray, y, x, plane, same, m, other, size, radius, spacing, noise):  # type: ignore[no-untyped-def]
    """Compare the window around a pixel with its match in a neighbour, given the pixel's plane.

    Returns correlation, shift, parallax and weight. The correlation is -1 if the neighbour does not
    show the whole window. The shift, in pixels along the epipolar line, is one Lucas-Kanade step
    that compensates differences of contrast and brightness. The parallax is how far the match
    moves, in pixels per unit of inverse depth. The weight is 0 if the window has no texture.
    """
    nothing = np.float32(-1), np.float32(0), 0.0, np.float32(0)
    w, right, down = plane
    px, py, pz = _project(m, x, y, w)
    if not pz > 0:
        return nothing
    ax = (m[0, 0] + right * m[0, 3] - px * (m[2, 0] + right * m[2, 3])) / pz
    ay = (m[1, 0] + right * m[1, 3] - py * (m[2, 0] + right * m[2, 3])) / pz
    bx = (m[0, 1] + down * m[0, 3] - px * (m[2, 1] + down * m[2, 3])) / pz
    by = (m[1, 1] + down * m[1, 3] - py * (m[2, 1] + down * m[2, 3])) / pz
    reach_x, reach_y = radius * (abs(ax) + abs(bx)), radius * (abs(ay) + abs(by))
    if not (reach_x <= px < size[0] - 2 - reach_x and reach_y <= py < size[1] - 2 - reach_y):
        return nothing
    gx, gy = (m[0, 3] - px * m[2, 3]) / pz, (m[1, 3] - py * m[2, 3]) / pz
    parallax = math.sqrt(gx * gx + gy * gy)
    if parallax < 1e-9:
        return nothing
    gx, gy = np.float32(gx / parallax), np.float32(gy / parallax)
    ax, ay, bx, by = np.float32(ax), np.float32(ay), np.float32(bx), np.float32(by)
    fx, fy = np.float32(px), np.float32(py)
    here, middle = gray[y, x], other[int(py), int(px)]
    n = sp = sv = ss = pp = vv = sss = vs = pv = ps = np.float32(0)
    for j in range(-radius, radius + 1, spacing):
        for i in range(-radius, radius + 1, spacing):
            if not same[j + radius, i + radius]:
                continue
            qx, qy = fx + ax * i + bx * j, fy + ay * i + by * j
            left, top = int(qx), int(qy)
            tx, ty = qx - np.float32(left), qy - np.float32(top)
            v00, v01 = other[top, left], other[top, left + 1]
            v10, v11 = other[top + 1, left], other[top + 1, left + 1]
            above, below = v00 + tx * (v01 - v00), v10 + tx * (v11 - v10)
            v = above + ty * (below - above) - middle
            across = v01 - v00 + ty * (v11 - v10 - v01 + v00)
            s = gx * across + gy * (below - above)
            p = gray[y + j, x + i] - here
            n += np.float32(1)
            sp += p
            sv += v
            ss += s
            pp += p * p
            vv += v * v
            sss += s * s
            vs += v * s
            pv += p * v
            ps += p * s
    floor = n * noise * noise
    own = pp - sp * sp / n + floor
    spread = vv - sv * sv / n + floor
    steep = sss - ss * ss / n + floor
    mixed = vs - sv * ss / n
    covariance = pv - sp * sv / n + floor
    moved = ps - sp * ss / n
    area = spread * steep - mixed * mixed
    gain = (covariance * steep - moved * mixed) / area
    shift = (moved * spread - covariance * mixed) / (area * max(gain, MIN_GAIN))
    shift = min(max(shift, np.float32(-1)), np.float32(1))
    textured = steep - (1 + MIN_TEXTURE) * floor - mixed * mixed / spread
    weight = max(textured, np.float32(0)) / own
    return covariance / np.float32(math.sqrt(own * spread)), shift, parallax, weight


@compiled(nogil=True)
def _score(gray, y, x, plane, same, neighbours, sizes, maps, radius, spacing, noise, sure):  # type: ignore[no-untyped-def]
    """Return the mean of the two best correlations of a window with the neighbours."""
    best = second = np.float32(-1)
    for k in range(len(neighbours)):
        found = _compare(
            gray, y, x, plane, same, maps[k], neighbours[k], sizes[k], radius, spacing, noise
        )[0]
        second = max(second, min(best, found))
        best = max(best, found)
        if second >= sure:
            break
    return np.float32(0.5) * (best + second)


@compiled(nogil=True)
def propagate_rows(  # type: ignore[no-untyped-def]
    first, last, planes, scores, jump, sure, stride, gray, neighbours, sizes, maps, radius, spacing,
    noise, out, found,
):  # fmt: skip
    """Let each pixel whose window correlates worse than `sure` try the planes of four other pixels.

    The four pixels lie `jump` pixels to the right, left, below and above. If `jump` is 0, only the
    pixel's own plane is tested. The plane that correlates best is taken. `scores` are correlations
    of the given planes, `found` those of the new planes. Other arguments are as in `refine_rows`.
    """
    height, width = gray.shape
    rows, columns = planes.shape[:2]
    same = np.ones((2 * radius + 1, 2 * radius + 1), np.bool_)
    plane = np.empty(3, np.float32)
    for row in range(first, last):
        for column in range(columns):
            out[row, column] = planes[row, column]
            best = scores[row, column]
            y, x = row * stride, column * stride
            inside = radius <= y < height - radius and radius <= x < width - radius
            if best < sure and inside:
                for turn in range(4 if jump else 1):
                    across = (jump, -jump, 0, 0)[turn]
                    down = (0, 0, jump, -jump)[turn]
                    r, c = row + down, column + across
                    if not (0 <= r < rows and 0 <= c < columns) or scores[r, c] < best:
                        continue
                    plane[:] = planes[r, c]
                    plane[0] -= stride * (across * plane[1] + down * plane[2])
                    if not plane[0] > 0:
                        continue
                    score = _score(
                        gray, y, x, plane, same, neighbours, sizes, maps, radius, spacing, noise,
                        sure,
                    )  # fmt: skip
                    if score > best:
                        best = score
                        out[row, column] = plane
            found[row, column] = best


@compiled(nogil=True)
def refine_rows(  # type: ignore[no-untyped-def]
    first, last, planes, stride, gray, neighbours, sizes, maps, radius, spacing, noise, tolerance,
    min_correlation, min_number, out, errors, certainty,
):  # fmt: skip
    """Refine each inverse depth by one Lucas-Kanade step that all neighbours share.

    `planes` are as in `fit_rows`, for every `stride`-th pixel of `gray` in both directions, but
    with slopes per pixel of `gray`. `neighbours` (K, H', W') float32 are padded images of (width,
    height) `sizes` (K, 2). `maps` (K, 3, 4) are as in `relative_projections`. Every `spacing`-th
    pixel of a window is compared if its inverse depth is within `tolerance` of the middle's plane.

    The new inverse depth `out` is NaN if fewer than `min_number` neighbours reach
    `min_correlation`, and unchanged if these have no texture along the epipolar line. In both
    cases, `certainty` is 0. `errors` are root mean square distances, in pixels, from the match at
    the new inverse depth to the matches that each neighbour alone would give.
    """
    height, width = gray.shape
    side = 2 * radius + 1
    same = np.empty((side, side), np.bool_)
    shifts, parallaxes = np.empty((2, len(neighbours)))
    for row in range(first, last):
        for column in range(planes.shape[1]):
            w, right, down = planes[row, column]
            out[row, column] = w
            errors[row, column] = certainty[row, column] = 0
            if not w > 0:
                continue
            y, x = row * stride, column * stride
            for j in range(-radius, radius + 1, spacing):
                for i in range(-radius, radius + 1, spacing):
                    r = min((y + j + stride // 2) // stride, planes.shape[0] - 1)
                    c = min((x + i + stride // 2) // stride, planes.shape[1] - 1)
                    near = 0 <= y + j < height and 0 <= x + i < width
                    if near:
                        expected = w + right * (c * stride - x) + down * (r * stride - y)
                        near = abs(planes[r, c, 0] - expected) <= tolerance
                    same[j + radius, i + radius] = near
            same[radius, radius] = True
            step = information = 0.0
            number = 0
            for k in range(len(neighbours)):
                correlation, shift, parallax, weight = _compare(
                    gray, y, x, planes[row, column], same, maps[k], neighbours[k], sizes[k], radius,
                    spacing, noise,
                )  # fmt: skip
                if correlation >= min_correlation:
                    step += parallax * weight * shift
                    information += parallax * parallax * weight
                    shifts[number], parallaxes[number] = shift, parallax
                    number += 1
            out[row, column] = np.nan
            if number >= min_number:
                certainty[row, column] = information
                step /= max(information, 1e-12)
                out[row, column] = w + step
                squares = ((shifts[:number] - parallaxes[:number] * step) ** 2).sum()
                errors[row, column] = math.sqrt(squares / number)


@compiled(nogil=True)
def fuse_rows(  # type: ignore[no-untyped-def]
    first, last, planes, neighbours, sizes, stride, there, back, rays, centres, max_error,
    max_difference, min_angle, fused, views, shown,
):  # fmt: skip
    """Write, for each pixel of the first map, the mean inverse depth of the maps that agree on it.

    The first map `planes` and the padded `neighbours` (K, H', W', 3) are as in `refine_rows`.
    `sizes` (K, 2) are the rows and columns of the neighbours. `there` (K, 3, 4) project the first
    image to each neighbour, as in `relative_projections`, and `back` the other way. `rays` (3, 3)
    maps pixels (x, y, 1) to lines of sight. `centres` (K, 3) are the neighbours' camera centres in
    the frame of the first camera.

    A neighbour agrees if its own surface point reprojects to within `max_error` pixels of the
    pixel, and its inverse depth differs by at most the fraction `max_difference`. `views` (H, W)
    counts the images that agree, `shown` (H, W) the images whose frame contains the point. Both
    counts include the first image. `views` is 0 unless the line of sight of some agreeing image
    differs by `min_angle` radians from that of the first image.
    """
    for row in range(first, last):
        for column in range(planes.shape[1]):
            w, right, below = planes[row, column]
            views[row, column] = shown[row, column] = 0
            if not w > 0:
                continue
            x, y = float(column * stride), float(row * stride)
            line = rays[:, 0] * x + rays[:, 1] * y + rays[:, 2]
            total, count, inside, widest = float(w), 1, 1, 0.0
            for k in range(len(neighbours)):
                m, n = there[k], back[k]
                px, py, pz = _project(m, x, y, w)
                if not pz > 0:
                    continue
                c, r = math.floor(px / stride + 0.5), math.floor(py / stride + 0.5)
                if not (0 <= r < sizes[k, 0] and 0 <= c < sizes[k, 1]):
                    continue
                inside += 1
                its, its_right, its_down = neighbours[k, r, c]
                its += its_right * (px - c * stride) + its_down * (py - r * stride)
                if not its > 0:
                    continue
                qx, qy, qz = _project(n, px, py, its)
                if not qz > 0:
                    continue
                dx, dy = qx - x, qy - y
                seen = its / qz
                if dx * dx + dy * dy > max_error * max_error or abs(seen - w) > max_difference * w:
                    continue
                total += seen - right * dx - below * dy
                count += 1
                other = line / w - centres[k]
                product = (line * other).sum()
                product /= math.sqrt((line * line).sum() * (other * other).sum())
                widest = max(widest, math.acos(min(max(product, -1.0), 1.0)))
            shown[row, column] = inside
            if widest >= min_angle:
                fused[row, column] = total / count
                views[row, column] = count


@compiled(nogil=True)
def support_rows(first, last, planes, stride, chosen, reach, spacing, tolerance, support):  # type: ignore[no-untyped-def]
    """Write the fraction of each pixel's neighbourhood that is `chosen` and on the pixel's surface.

    The neighbourhood is every `spacing`-th pixel up to `reach` away, the pixel itself included.
    `chosen` (H, W) is a mask, and `planes` are as in `refine_rows`. A pixel is on the surface if
    its inverse depth differs from the middle pixel's plane by at most the fraction `tolerance`.
    """
    height, width = chosen.shape
    for row in range(first, last):
        for column in range(width):
            w, right, down = planes[row, column]
            inside = number = 0
            for j in range(-reach, reach + 1, spacing):
                for i in range(-reach, reach + 1, spacing):
                    r, c = row + j, column + i
                    if not (0 <= r < height and 0 <= c < width):
                        continue
                    inside += 1
                    rest = planes[r, c, 0] - w - stride * (i * right + j * down)
                    number += chosen[r, c] and abs(rest) <= tolerance * w
            support[row, column] = number / inside
