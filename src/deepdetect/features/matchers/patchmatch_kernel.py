"""The compiled part of `patchmatch`. Importing it needs numba; the first call compiles."""

from __future__ import annotations

import numpy as np

from ..._shared.kernels import compiled


@compiled(nogil=True, inline="always")
def _distance(queries, query, base, row):  # type: ignore[no-untyped-def]
    """Return the squared Euclidean distance; all in 32 bits, for speed."""
    total = np.int32(0)
    for d in range(queries.shape[1]):
        gap = np.int32(np.int32(queries[query, d]) - np.int32(base[row, d]))
        total = np.int32(total + np.int32(gap * gap))
    return total


@compiled(nogil=True, inline="always")
def _insert(row, distance, best, second, nearer, farther):  # type: ignore[no-untyped-def]
    """Return the best two rows and their distances after one more row."""
    if distance < nearer:
        return row, best, distance, nearer
    if distance < farther:
        return best, row, nearer, distance
    return best, second, nearer, farther


@compiled(nogil=True, inline="always")
def _hash(number):  # type: ignore[no-untyped-def]
    """Return a hash of a number (Wellons's lowbias32)."""
    number = np.uint32(number)
    number ^= number >> np.uint32(16)
    number = np.uint32(number * np.uint32(0x7FEB352D))
    number ^= number >> np.uint32(15)
    number = np.uint32(number * np.uint32(0x846CA68B))
    number ^= number >> np.uint32(16)
    return number


@compiled(nogil=True)
def start(first, last, queries, base, seed, rows, distances):  # type: ignore[no-untyped-def]
    """Give the queries from `first` to before `last` two random rows of the base."""
    count = len(base)
    for query in range(first, last):
        state = _hash(np.uint32(query) ^ _hash(np.uint32(seed)))
        best = np.int64(state) % count
        second = np.int64(_hash(state)) % count
        if second == best:
            second = (best + 1) % count
        nearer, farther = (
            _distance(queries, query, base, best),
            _distance(queries, query, base, second),
        )
        if farther < nearer:
            best, second, nearer, farther = second, best, farther, nearer
        rows[query, 0], rows[query, 1] = best, second
        distances[query, 0], distances[query, 1] = nearer, farther


@compiled(nogil=True)
def sweep(  # type: ignore[no-untyped-def]
    first, last, bands, queries, base, xy0, xy1, at0, at1, offsets, turn, seed, radii, before, rows,
    distances,
):  # fmt: skip
    """Improve the queries of the bands from `first` to before `last`, one after the other.

    Args:
        first, last: numbers of the bands.
        bands: (B + 1,) query that each band begins with, in row-major order.
        queries, base: (N, D), (M, D) uint8 descriptors.
        xy0, xy1: their pixels.
        at0, at1: (H, W) int32 row at each pixel, -1 where there is none.
        offsets: distances in pixels to the queries whose neighbours are tried.
        turn: number of the sweep; even ones go down, odd ones up.
        seed: of the random tries.
        radii: of the random tries around the best, in pixels.
        before: (N, 2) rows as they were before this sweep, for queries of other bands: so the
            bands may be done in any order.
        rows, distances: (N, 2) best and second-best row and squared distances; improved.
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
                if trial < spread:  # what two queries beside this one found, moved along
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
                else:  # random places around the best
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
                    best, second, nearer, farther = _insert(
                        row, distance, best, second, nearer, farther
                    )
            rows[query, 0], rows[query, 1] = best, second
            distances[query, 0], distances[query, 1] = nearer, farther
