"""Compiled kernels of stereo matching. Importing this module loads numba; first calls compile.

Kernels named `..._rows` process the rows `first` to `last - 1` of their arrays. The innermost axis
of an array is the disparity or the column, so that vector instructions process many values at once.
Sums of costs have 16 bits.
"""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled

END = np.uint16(30000)
"""Cost of disparities outside the searched range: above any sum, below 2^16 even with a penalty."""

BLOCK = 128
"""Number of pixels of a row that are processed together, so that the sums stay in the L1 cache."""


@compiled(nogil=True)
def census_rows(first, last, padded, out):  # type: ignore[no-untyped-def]
    """Write for each pixel which of its neighbours are darker, one bit each, to `out`.

    `padded` is the uint8 image, padded by the radius of the window, and `out` is (H, W) uint64.
    """
    height, width = out.shape
    radius_y, radius_x = (padded.shape[0] - height) // 2, (padded.shape[1] - width) // 2
    side = 2 * radius_x + 1
    middle = radius_y * side + radius_x
    bits = (2 * radius_y + 1) * side - 1
    part = np.empty(width, np.uint8)
    for y in range(first, last):
        out[y] = 0
        here = padded[y + radius_y, radius_x:]
        for start in range(0, bits, 8):  # in bytes: a vector register holds more bytes than words
            end = min(start + 8, bits)
            part[:] = 0
            for bit in range(start, end):
                place = bit + 1 if bit >= middle else bit
                neighbour = padded[y + place // side, place % side :]
                for x in range(width):
                    darker = neighbour[x] < here[x]
                    part[x] = np.uint8(part[x] << np.uint8(1)) | np.uint8(darker)
            for x in range(width):
                out[y, x] = (out[y, x] << np.uint64(end - start)) | np.uint64(part[x])


@compiled(nogil=True, inline="always")
def count_bits(word):  # type: ignore[no-untyped-def]
    """Count the 1 bits of a 64-bit word; the compiler turns this form into one instruction."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + (
        (word >> np.uint64(2)) & np.uint64(0x3333333333333333)
    )
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (word * np.uint64(0x0101010101010101)) >> np.uint64(56)


@compiled(nogil=True)
def _distances(left, right_mirrored, min_disparity, outside, out):  # type: ignore[no-untyped-def]
    """Write the Hamming distances between the censuses of one row of both views, (W, D) uint8."""
    width, count = out.shape
    for x in range(width):
        # The right column c = x - min_disparity - d is column width - 1 - c of the mirrored view.
        start = width - 1 - x + min_disparity
        low = min(max(0, -start), count)
        high = max(min(count, width - start), low)
        out[x, :low] = outside
        out[x, high:] = outside
        word = left[x]
        for d in range(low, high):
            out[x, d] = np.uint8(count_bits(word ^ right_mirrored[start + d]))


@compiled(nogil=True)
def cost_rows(first, last, left, right_mirrored, min_disparity, outside, cost):  # type: ignore[no-untyped-def]
    """Write the costs of D disparities from `min_disparity` on, (H, W, D) uint8.

    `left` and `right_mirrored` are (H, W) uint64 censuses, the right one mirrored left to right.
    `outside` is the Hamming distance that is assumed for places outside the right image.
    """
    height, width, count = cost.shape
    line = np.empty((width, count), np.uint8)
    sums = np.empty((3, width, count), np.uint8)  # distances of three pixels: at most 3 x 62
    done = first - 2
    for y in range(first, last):
        for row in range(max(y - 1, done + 1), y + 2):
            at = min(max(row, 0), height - 1)
            _distances(left[at], right_mirrored[at], min_disparity, outside, line)
            for x in range(width):
                before, after = line[max(x - 1, 0)], line[min(x + 1, width - 1)]
                here, out = line[x], sums[row % 3, x]
                for d in range(count):
                    out[d] = np.uint8(np.uint8(before[d] + here[d]) + after[d])
            done = row
        for x in range(width):
            above, here, below = sums[(y + 2) % 3, x], sums[y % 3, x], sums[(y + 1) % 3, x]
            out = cost[y, x]
            for d in range(count):
                total = np.uint16(np.uint16(above[d]) + np.uint16(here[d]))
                out[d] = np.uint8(np.uint16(total + np.uint16(below[d])) >> np.uint16(2))


@compiled(nogil=True, inline="always")
def _step(before, least, cost, total, after, p1, p2):  # type: ignore[no-untyped-def]
    """Advance one pixel along a path, and return the lowest cost there.

    `before` and `after`, (D + 2,) uint16, are the costs of the path at the previous pixel and at
    this one, with `END` on both sides. `least` is the lowest of `before`. `cost`, (D,) uint8, holds
    the matching costs of this pixel. The costs of the path are added to `total`. `p1` is the
    penalty for a disparity that changes by one, `p2` the penalty for a larger change.
    """
    count = cost.shape[0]
    jump = np.uint16(least + p2)
    lowest = np.uint16(65535)
    for d in range(count):
        path = min(before[d + 1], jump)
        path = min(path, np.uint16(before[d] + p1))
        path = min(path, np.uint16(before[d + 2] + p1))
        path = np.uint16(np.uint16(path - least) + np.uint16(cost[d]))
        after[d + 1] = path
        total[d] = np.uint16(total[d] + path)
        lowest = min(lowest, path)
    return lowest


@compiled(nogil=True)
def sum_along_paths(first, last, gray, cost, total, down, right, p1, p2):  # type: ignore[no-untyped-def]
    """Add to `total` the costs along the paths `first` to `last - 1` of one direction.

    `down` and `right` are 1, -1 or 0: the step from pixel to pixel. Paths along rows are numbered
    by their row, all others by the column where they start. A diagonal path that leaves the image
    at one side continues at the other, so there are as many paths as columns. `p1` is the penalty
    for a disparity that changes by one, `p2[g]` for a larger change where grey levels differ by g.
    """
    height, width, count = cost.shape
    paths, steps = last - first, height if down else width
    lines = np.zeros((2, paths, count + 2), np.uint16)
    lines[:, :, 0] = lines[:, :, count + 1] = END
    leasts = np.zeros(paths, np.uint16)
    tones = np.zeros(paths, np.uint8)
    for k in range(paths * steps):  # pixels in the order in which memory holds them
        if down:
            step, path = k // paths, k % paths
            y = step if down == 1 else height - 1 - step
            x = (first + path + right * step) % width
        else:
            step, path = k % steps, k // steps
            y = first + path
            x = step if right == 1 else width - 1 - step
        if step == 0 or (right == 1 and x == 0) or (right == -1 and x == width - 1):
            lines[step % 2, path, 1 : count + 1] = 0
            leasts[path] = 0
            tones[path] = gray[y, x]
        change = abs(np.int32(gray[y, x]) - np.int32(tones[path]))
        tones[path] = gray[y, x]
        leasts[path] = _step(
            lines[step % 2, path], leasts[path], cost[y, x], total[y, x],
            lines[1 - step % 2, path], p1, p2[change],
        )  # fmt: skip


@compiled(nogil=True)
def best_of_rows(first, last, total, min_disparity, count, disparity, consistent, uniqueness_ratio):  # type: ignore[no-untyped-def]
    """Choose the disparity of lowest cost for each pixel, in both views.

    `total`, (H, W, D) uint16, has the costs of D disparities from `min_disparity` on, of which the
    first `count` may be chosen. `disparity`, `consistent` and `uniqueness_ratio` are written; see
    `sgm.SGMResult`. A parabola through the lowest cost and its two neighbours makes the disparity
    sub-pixel. The views are consistent if their disparities differ by at most one.
    """
    width = total.shape[1]
    best = np.empty(width, np.int64)
    keys = np.empty(width, np.uint32)  # per column of the mirrored right row: 2^16 cost + index
    for y in range(first, last):
        keys[:] = np.uint32(0xFFFFFFFF)
        for x in range(width):
            sums = total[y, x]
            # Disparities that lead inside the right image: 0 <= x - min_disparity - d < width.
            low = min(max(0, x - min_disparity - width + 1), count)
            high = max(min(count, x - min_disparity + 1), low)
            own = keys[width - 1 - x + min_disparity + low :]
            first_inside = np.uint32(0xFFFFFFFF)
            for d in range(high - low):
                key = (np.uint32(sums[low + d]) << np.uint32(16)) | np.uint32(low + d)
                own[d] = min(own[d], key)
                first_inside = min(first_inside, key)
            inside = least = np.uint16(first_inside >> np.uint32(16))
            for d in range(low):
                least = min(least, sums[d])
            for d in range(high, count):
                least = min(least, sums[d])
            # A match inside the right image is preferred to one outside with the same cost.
            seen = low < high and inside == least
            at = np.int64(first_inside & np.uint32(0xFFFF)) if seen else np.int64(0)
            while sums[at] != least:
                at += 1
            best[x] = at
            consistent[y, x] = seen
            uniqueness_ratio[y, x] = np.float32(1)
            fraction = np.float32(0)
            if seen:
                other = np.uint16(65535)
                for d in range(low, at - 1):
                    other = min(other, sums[d])
                for d in range(at + 2, high):
                    other = min(other, sums[d])
                ratio = np.float32(other) / np.float32(max(least, np.uint16(1)))
                uniqueness_ratio[y, x] = ratio
                if low < at < high - 1:
                    before, here, after = float(sums[at - 1]), float(least), float(sums[at + 1])
                    bend = before + after - 2 * here
                    if bend > 0:
                        fraction = np.float32(0.5 * (before - after) / bend)
            disparity[y, x] = np.float32(at + min_disparity) + fraction
        for x in range(width):
            if consistent[y, x]:
                at = width - 1 - x + min_disparity + best[x]
                from_right = np.int64(keys[at] & np.uint32(0xFFFF))
                consistent[y, x] = abs(from_right - best[x]) <= 1


@compiled(nogil=True, fastmath=True)
def smooth_rows(first, last, disparity, radius, max_difference, out):  # type: ignore[no-untyped-def]
    """Write for each pixel the mean disparity of the surface that it lies on, within a window.

    `disparity` is padded by `radius`. Two pixels on opposite sides of the centre count only if the
    disparities of both differ from the centre's by at most `max_difference`. Slanted planes
    therefore keep their disparity, also next to an edge.
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
    """Sample the right image at x - disparity by cubic interpolation (Catmull-Rom).

    `values` and `slopes` are written. All arrays are (H, W) float32. `slopes` is the gradient of
    the right image along the row, in grey levels per pixel.
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
    """Write the disparity after one Lucas-Kanade step along the row.

    In each window, gain * (values - change * slopes) + offset is fitted to the left grey values,
    and `change` is added to the disparity. Only pixels whose disparity differs from the centre's by
    at most `max_difference` are used. All inputs are padded by `radius`; `sample_rows` gives
    `values` and `slopes`. Slopes below `noise` damp the change; a gain below `min_gain` makes it 0.
    """
    width = out.shape[1]
    n, p, v, s, vv, ss, vs, pv, ps = np.empty((9, BLOCK), np.float32)
    for y in range(first, last):
        for start in range(0, width, BLOCK):
            count = min(BLOCK, width - start)
            row, column = y + radius, start + radius
            here = disparity[row, column : column + count]
            # The grey level of the centre is subtracted: sums stay small and exact.
            middle = left[row, column : column + count]
            other = values[row, column : column + count]
            # Sums over the window: count (n), left and right grey (p, v), slope (s), products.
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
                covariance = pv[x] - p[x] * v[x] / n[x] + floor  # a flat window gets gain 1
                moved = ps[x] - p[x] * s[x] / n[x]
                area = spread * steep - mixed * mixed
                gain = (covariance * steep - moved * mixed) / area
                change = (covariance * mixed - moved * spread) / area
                ratio = change / gain if gain > min_gain else np.float32(0)
                out[y, start + x] = here[x] + min(max(ratio, np.float32(-1)), np.float32(1))


@compiled(nogil=True, inline="always")
def _line_at(sums, first, last, x):  # type: ignore[no-untyped-def]
    """Return the value at x of the line fitted to points first to last - 1.

    Column i of `sums` holds the sums of x, x * x, value and x * value over the points before i.
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
    """Extrapolate the first known surface of each row to the left, outside the other view.

    `carried` holds integer disparities of semi-global matching, which continue surrounding
    surfaces. The other view shows column x at x - sign * disparity, where `sign` is 1, or -1 for
    mirrored views. `out` is written only where the surface is extrapolated.
    """
    width = disparity.shape[1]
    sums = np.zeros((4, width + 1), np.float64)
    for y in range(first, last):
        start = 0
        while start < width and not known[y, start]:
            start += 1
        # The line is fitted to at most twice as many pixels as are extrapolated.
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
            # `carried` is an integer, so it may be off by half a pixel.
            if abs(carried[y, x] - disparity[y, start]) > max_difference + np.float32(0.5):
                continue
            continued = _line_at(sums, 0, 2 * reach, np.float64(x - start))
            if np.float64(x) - sign * continued < 0:
                out[y, x] = np.float32(continued)
