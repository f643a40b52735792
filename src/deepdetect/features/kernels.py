"""Compiled functions for descriptors, orientations, matchers, nearest keypoints and suppression.

Dense SIFT works in tiles, so that intermediate results stay in the processor's cache. Each pixel of
a tile divides its vote between the two nearest of eight orientations. The votes are summed along
the rows of a tile into the four columns of each descriptor's bins, and then along the columns of
the tile into the four rows of bins. The innermost loops run over adjacent memory.
"""

from __future__ import annotations

import math

import numpy as np

from .._shared.kernels import compiled

TILE_COLUMNS, TILE_HEIGHT = 32, 96
"""Width of a tile of dense SIFT in columns of keypoints, and height in pixels. Chosen by hand."""

TAPS_AT_ONCE = 4
"""Dense SIFT sums this many filter taps per step; spans of taps are padded to its multiples."""

BINS, RADIUS_PER_WINDOW = 36, 3.0
"""The histogram of gradient directions around a keypoint has BINS bins, as in Lowe (2004). Pixels
vote up to RADIUS_PER_WINDOW sigmas of the Gaussian window from the keypoint, as in OpenCV."""

CHUNK = 64
"""Exact search keeps one minimum per CHUNK distances, to find minima faster. Chosen by hand."""


@compiled(nogil=True, fastmath=True)
def describe_tiles(first, last, magnitude, orientation, rows_of, origin, step, taps, spans, out):  # type: ignore[no-untyped-def]
    """Write SIFT descriptors of the keypoints in tiles `first` to `last` (exclusive) into `out`.

    `magnitude` and `orientation` come from `sift_gradient`. Keypoints lie on a lattice of points
    that are `step` pixels apart; the first is the pixel `origin`, (x, y). `rows_of` holds for each
    point of the lattice the row of its keypoint in `out`, or -1 without a keypoint. `taps`, (4, T),
    holds for each of the four spatial bins the weights of T pixels along one axis around a
    keypoint, padded with zeros. `spans`, (4, 3), holds for each bin the index of the first nonzero
    tap, the end of its span of taps (a multiple of `TAPS_AT_ONCE` long), and T.
    """
    height, width = magnitude.shape
    reach = spans[0, 2] // 2
    tile_rows = max(1, TILE_HEIGHT // step)
    across = (rows_of.shape[1] + TILE_COLUMNS - 1) // TILE_COLUMNS
    more_columns = (taps.shape[1] + step - 1) // step
    soft = np.zeros((step, 8 * (TILE_COLUMNS + more_columns)), np.float32)
    height_of_tile = (tile_rows - 1) * step + taps.shape[1]
    summed = np.zeros((height_of_tile, 32 * TILE_COLUMNS), np.float32)
    histogram = np.zeros((4, 32 * TILE_COLUMNS), np.float32)
    for tile in range(first, last):
        top, left = tile // across * tile_rows, tile % across * TILE_COLUMNS
        bottom = min(top + tile_rows, rows_of.shape[0])
        right = min(left + TILE_COLUMNS, rows_of.shape[1])
        while top < bottom and (rows_of[top, left:right] < 0).all():
            top += 1
        while top < bottom and (rows_of[bottom - 1, left:right] < 0).all():
            bottom -= 1
        if top == bottom:
            continue
        while (rows_of[top:bottom, left] < 0).all():
            left += 1
        while (rows_of[top:bottom, right - 1] < 0).all():
            right -= 1
        numbers = 8 * (right - left)  # numbers per spatial bin: eight orientations for each column
        x0, y0 = origin[0] + left * step - reach, origin[1] + top * step - reach
        for j in range((bottom - top - 1) * step + 2 * reach + 1):
            y = y0 + j
            if y < 1 or y >= height - 1:
                summed[j] = 0
                continue
            soft[:] = 0
            for phase in range(step):
                for k in range(right - left + more_columns):
                    x = x0 + phase + k * step
                    if x < 1 or x >= width - 1:
                        continue
                    turn = orientation[y, x]
                    whole = int(turn)
                    part = turn - np.float32(whole)
                    soft[phase, 8 * k + (whole & 7)] = magnitude[y, x] * (np.float32(1) - part)
                    soft[phase, 8 * k + ((whole + 1) & 7)] = magnitude[y, x] * part
            _sum_along_row(soft, taps, spans, step, summed[j], numbers)
        for row in range(top, bottom):
            if (rows_of[row, left:right] < 0).all():
                continue
            _sum_along_column(summed[(row - top) * step :], taps, spans, histogram, 4 * numbers)
            for i in range(right - left):
                if rows_of[row, left + i] >= 0:
                    _normalise(histogram[:, 8 * i :], numbers, out[rows_of[row, left + i]])


@compiled(nogil=True, fastmath=True, inline="always")
def _sum_along_row(soft, taps, spans, step, out, numbers):  # type: ignore[no-untyped-def]
    out[:] = 0
    for b in range(4):
        of_bin = out[b * numbers : (b + 1) * numbers]
        for t in range(spans[b, 0], spans[b, 1], TAPS_AT_ONCE):
            weights = taps[b, t], taps[b, t + 1], taps[b, t + 2], taps[b, t + 3]
            _add(
                of_bin,
                weights,
                soft[t % step, t // step * 8 :],
                soft[(t + 1) % step, (t + 1) // step * 8 :],
                soft[(t + 2) % step, (t + 2) // step * 8 :],
                soft[(t + 3) % step, (t + 3) // step * 8 :],
            )


@compiled(nogil=True, fastmath=True, inline="always")
def _sum_along_column(summed, taps, spans, out, numbers):  # type: ignore[no-untyped-def]
    out[:] = 0
    for b in range(4):
        for t in range(spans[b, 0], spans[b, 1], TAPS_AT_ONCE):
            weights = taps[b, t], taps[b, t + 1], taps[b, t + 2], taps[b, t + 3]
            _add(out[b, :numbers], weights, summed[t], summed[t + 1], summed[t + 2], summed[t + 3])


@compiled(nogil=True, fastmath=True)
def _add(out, weights, a, b, c, d):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        out[i] += weights[0] * a[i] + weights[1] * b[i] + weights[2] * c[i] + weights[3] * d[i]


@compiled(nogil=True, fastmath=True, inline="always")
def _normalise(histogram, numbers, out):  # type: ignore[no-untyped-def]
    """Clip a descriptor at 0.2 of its norm, scale it to norm 512 and round, as in OpenCV."""
    total = np.float32(0)
    for b in range(4):
        for c in range(0, 4 * numbers, numbers):
            for o in range(8):
                total += histogram[b, c + o] * histogram[b, c + o]
    most = np.sqrt(total) * np.float32(0.2)
    total = np.float32(0)
    for b in range(4):
        for c in range(0, 4 * numbers, numbers):
            for o in range(8):
                value = min(histogram[b, c + o], most)
                total += value * value
    scale = np.float32(512) / max(np.sqrt(total), np.float32(1.1920929e-07))
    for b in range(4):
        for c in range(4):
            for o in range(8):
                value = min(histogram[b, c * numbers + o], most)
                value = np.rint(value * scale)
                out[32 * b + 8 * c + o] = np.uint8(min(np.float32(255), value))


@compiled(nogil=True)
def nearest_of_nine(first, last, positions, xy, grid, nearest, distances):  # type: ignore[no-untyped-def]
    """Find, for each position, the nearest of (M, 2) keypoints, `xy`, in the 3x3 pixels around it.

    `grid`, (H, W), holds the row in `xy` of each pixel's keypoint, or -1. Nothing is written into
    `nearest` for positions that are not finite, or that have no keypoint in these pixels.
    """
    height, width = grid.shape
    for k in range(first, last):
        x, y = positions[k, 0], positions[k, 1]
        if not (-1.5 < x < width + 0.5 and -1.5 < y < height + 0.5):
            continue
        column, row = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        least = np.inf
        for j in range(max(row - 1, 0), min(row + 2, height)):
            for i in range(max(column - 1, 0), min(column + 2, width)):
                one = grid[j, i]
                if one < 0:
                    continue
                squared = (xy[one, 0] - x) ** 2 + (xy[one, 1] - y) ** 2
                if squared < least:
                    least = squared
                    nearest[k] = one
        distances[k] = np.sqrt(least)


@compiled(nogil=True, inline="always")
def _distance(queries, query, base, row):  # type: ignore[no-untyped-def]
    """Return the squared Euclidean distance of uint8 descriptors, in 32-bit integers for speed."""
    total = np.int32(0)
    for d in range(queries.shape[1]):
        gap = np.int32(np.int32(queries[query, d]) - np.int32(base[row, d]))
        total = np.int32(total + np.int32(gap * gap))
    return total


# The flag "nnan" rules out NaN, so that the compiler can find minima by vector instructions.
@compiled(nogil=True, fastmath={"nnan", "nsz"})
def scan_products(products, terms0, terms1, start, rows, values, nearest, best, second):  # type: ignore[no-untyped-def]
    """Find nearest neighbours in both directions between a block of queries and the base.

    Squared distances are `terms0[i] + terms1[j] - 2 * products[i, j]`. `start` is the index of the
    block's first query. For each query, its K nearest rows of the base (the lowest row of a tie)
    are written into `rows`, and their squared distances into `values`. For each row of the base,
    `nearest` is updated to the nearest query of all blocks so far, and `best` and `second` to the
    squared distances of the two nearest queries.
    """
    count = products.shape[1]
    chunks = (count + CHUNK - 1) // CHUNK
    line = np.full(chunks * CHUNK, np.inf, np.float32)
    least = np.empty(chunks, np.float32)
    for query in range(len(products)):
        term, number = terms0[query], np.int32(start + query)
        for row in range(count):
            value = term + terms1[row] - np.float32(2) * np.float32(products[query, row])
            line[row] = value
            second[row] = min(second[row], max(best[row], value))
            nearest[row] = number if value < best[row] else nearest[row]
            best[row] = min(best[row], value)
        for chunk in range(chunks):
            least[chunk] = _least(line, chunk)
        for rank in range(rows.shape[1]):
            chunk = 0
            for other in range(1, chunks):
                chunk = other if least[other] < least[chunk] else chunk
            row = chunk * CHUNK
            while row < min((chunk + 1) * CHUNK, count) - 1 and line[row] != least[chunk]:
                row += 1
            rows[query, rank], values[query, rank] = row, line[row]
            line[row] = np.inf
            least[chunk] = _least(line, chunk)


@compiled(nogil=True, fastmath={"nnan", "nsz"}, inline="always")
def _least(line, chunk):  # type: ignore[no-untyped-def]
    value = line[chunk * CHUNK]
    for row in range(chunk * CHUNK, (chunk + 1) * CHUNK):
        value = min(value, line[row])
    return value


@compiled(nogil=True, inline="always")
def _hash(number):  # type: ignore[no-untyped-def]
    """Return a 32-bit hash of a number, by the function lowbias32."""
    number = np.uint32(number)
    number ^= number >> np.uint32(16)
    number = np.uint32(number * np.uint32(0x7FEB352D))
    number ^= number >> np.uint32(15)
    number = np.uint32(number * np.uint32(0x846CA68B))
    return number ^ (number >> np.uint32(16))


@compiled(nogil=True)
def patchmatch_start(first, last, queries, base, seed, rows, distances):  # type: ignore[no-untyped-def]
    """Give each query from `first` to `last` (exclusive) two random rows of the base as matches."""
    count = len(base)
    for query in range(first, last):
        state = _hash(np.uint32(query) ^ _hash(np.uint32(seed)))
        best = np.int64(state) % count
        second = np.int64(_hash(state)) % count
        if second == best:
            second = (best + 1) % count
        nearer = _distance(queries, query, base, best)
        farther = _distance(queries, query, base, second)
        if farther < nearer:
            best, second, nearer, farther = second, best, farther, nearer
        rows[query, 0], rows[query, 1] = best, second
        distances[query, 0], distances[query, 1] = nearer, farther


@compiled(nogil=True)
def patchmatch_sweep(  # type: ignore[no-untyped-def]
    first, last, bands, queries, base, xy0, xy1, at0, at1, offsets, turn, seed, radii, before, rows,
    distances,
):  # fmt: skip
    """Improve the two best matches of each query in the bands `first` to `last` (exclusive).

    `bands` holds the index of the first query in each band; queries are in row-major order. `at0`
    and `at1` hold the index of the keypoint on each pixel of the two images, or -1. `turn` is the
    number of the sweep: even sweeps go down the image, odd ones up. Two kinds of candidates are
    tried for a query: the matches of the queries at `offsets` from it, shifted by the offset, and
    random keypoints within `radii` around its best match. For a query of another band, its match
    before this sweep (`before`) is used, so that the order of the bands does not matter.
    """
    (height0, width0), (height1, width1) = at0.shape, at1.shape
    direction = 1 - 2 * (turn % 2)
    spread = 4 * len(offsets)
    for band in range(first, last):
        begin, end = bands[band], bands[band + 1]
        for step in range(end - begin):
            query = begin + step if direction == 1 else end - 1 - step
            best, second = rows[query, 0], rows[query, 1]
            nearer, farther = distances[query, 0], distances[query, 1]
            state = _hash(np.uint32(query) ^ _hash(np.uint32(seed + 7919 * (turn + 1))))
            for trial in range(spread + len(radii)):
                if trial < spread:  # the shifted match of a query at an offset in x or y
                    offset = offsets[trial // 4] * direction
                    right, down = (0, offset) if trial & 2 else (offset, 0)
                    x, y = xy0[query, 0] - right, xy0[query, 1] - down
                    if x < 0 or y < 0 or x >= width0 or y >= height0:
                        continue
                    other = at0[y, x]
                    if other < 0:
                        continue
                    row = (
                        rows[other, trial & 1] if begin <= other < end else before[other, trial & 1]
                    )
                    x, y = xy1[row, 0] + right, xy1[row, 1] + down
                else:  # a random position around the best match
                    radius = radii[trial - spread]
                    state = _hash(state + np.uint32(1))
                    along = np.int64(state % np.uint32(2 * radius + 1)) - radius
                    state = _hash(state + np.uint32(1))
                    x = xy1[best, 0] + along
                    y = xy1[best, 1] + np.int64(state % np.uint32(2 * radius + 1)) - radius
                if x < 0 or y < 0 or x >= width1 or y >= height1:
                    continue
                row = at1[y, x]
                if row >= 0 and row != best and row != second:
                    distance = _distance(queries, query, base, row)
                    if distance < nearer:
                        best, second, nearer, farther = row, best, distance, nearer
                    elif distance < farther:
                        second, farther = row, distance
            rows[query, 0], rows[query, 1] = best, second
            distances[query, 0], distances[query, 1] = nearer, farther


@compiled(nogil=True, error_model="numpy")
def keep_distant(cell, columns, x, y, radii, last, before, kept):  # type: ignore[no-untyped-def]
    """Keep each point, best first, unless a kept point is closer than the smaller of both radii.

    No position is negative. The rows of kept points are written into `kept` until it is full, and
    their number is returned. To find near points, the image is divided into squares with sides of
    `cell` pixels, `columns` of them in a row. The kept points in a square form a linked list:
    `last` holds the last point of each square, `before` the point before each; -1 means none.
    """
    rows, count = len(last) // columns, 0
    for k in range(len(x)):
        if count == len(kept):
            break
        row, column, reach = int(y[k] / cell), int(x[k] / cell), math.ceil(radii[k] / cell)
        left, right = max(column - reach, 0), min(column + reach + 1, columns)
        free = True
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for near in range(r * columns + left, r * columns + right):
                other = last[near]
                while other >= 0 and free:
                    radius = min(radii[k], radii[other])
                    free = (x[other] - x[k]) ** 2 + (y[other] - y[k]) ** 2 >= radius * radius
                    other = before[other]
        if free:
            kept[count] = k
            count += 1
            own = row * columns + column
            before[k], last[own] = last[own], k
    return count


ATAN = tuple(
    np.float32(np.float32(c) * np.float32(180 / np.pi))
    for c in (0.9997878412794807, -0.3258083974640975, 0.1555786518463281, -0.04432655554792128)
)
"""Coefficients of OpenCV's arctangent polynomial in degrees, so that votes go to its bins."""


@compiled(nogil=True, error_model="numpy")
def strongest_directions(image, pixels, windows):  # type: ignore[no-untyped-def]
    """Return the dominant gradient directions around (N, 2) pixels, (N,) float32 degrees.

    Gradients vote for `BINS` directions, weighted by a Gaussian window around the pixel, whose
    sigma is given in `windows`. The outermost pixels of the image do not vote.
    """
    height, width = image.shape
    angles = np.zeros(len(pixels), np.float32)
    side = 1
    for window in windows:
        side = max(side, 2 * int(np.rint(RADIUS_PER_WINDOW * window)) + 1)
    room = min(side, height) * min(side, width)
    dx, dy, weights = np.empty((3, room), np.float32)
    bins = np.empty(room, np.int32)
    across = np.empty(min(side, width), np.float32)
    votes, smooth = np.empty((2, BINS + 1)), np.empty(BINS)
    p1, p3, p5, p7 = ATAN
    for n in range(len(pixels)):
        column, row = pixels[n, 0], pixels[n, 1]
        radius = int(np.rint(RADIUS_PER_WINDOW * windows[n]))
        left, right = max(column - radius, 1), min(column + radius + 1, width - 1)
        for x in range(left, right):
            across[x - left] = math.exp(-0.5 * ((x - column) / windows[n]) ** 2)
        count = 0
        for y in range(max(row - radius, 1), min(row + radius + 1, height - 1)):
            down = np.float32(math.exp(-0.5 * ((y - row) / windows[n]) ** 2))
            above, here, below = image[y - 1, left:], image[y, left - 1 :], image[y + 1, left:]
            for x in range(right - left):
                dx[count + x] = here[x + 2] - here[x]
                dy[count + x] = below[x] - above[x]
                weights[count + x] = down * across[x]
            count += max(right - left, 0)
        for k in range(count):
            x, y = abs(dx[k]), abs(dy[k])
            high, low = (x, y) if x >= y else (y, x)
            part = low / (high + np.float32(2.220446049250313e-16))
            square = part * part
            angle = (((p7 * square + p5) * square + p3) * square + p1) * part
            angle = angle if x >= y else np.float32(90) - angle
            angle = angle if dx[k] >= 0 else np.float32(180) - angle
            angle = angle if dy[k] >= 0 else np.float32(360) - angle
            bins[k] = np.int32(np.rint(angle * np.float32(BINS / 360)))
            weights[k] *= np.sqrt(x * x + y * y)
        for k in range(BINS + 1):
            votes[0, k] = votes[1, k] = 0
        for k in range(count):
            votes[k & 1, bins[k]] += weights[k]
        for k in range(BINS):
            votes[0, k] += votes[1, k]
        votes[0, 0] += votes[0, BINS] + votes[1, BINS]
        best = 0
        for k in range(BINS):
            near = votes[0, (k - 1) % BINS] + votes[0, (k + 1) % BINS]
            far = votes[0, (k - 2) % BINS] + votes[0, (k + 2) % BINS]
            smooth[k] = (6 * votes[0, k] + 4 * near + far) / 16
            best = k if smooth[k] > smooth[best] else best
        before, after = smooth[best - 1], smooth[(best + 1) % BINS]
        curvature = before - 2 * smooth[best] + after
        shift = (before - after) / (2 * curvature) if curvature < 0 else 0.0
        degrees = np.float32((best + shift) * (360 / BINS))
        degrees += np.float32(360) if degrees < 0 else np.float32(0)
        angles[n] = degrees if degrees < 360 else np.float32(0)
    return angles
