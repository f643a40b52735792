"""Compiled parts of `dense_sift` and `sift`. Importing it needs numba; the first call compiles.

Dense SIFT works in tiles, so that intermediate results stay in the processor's cache: for each
pixel of a tile eight soft orientations, summed along its row into the descriptor's four columns,
then along the column into its four rows, at the keypoints only.
"""

from __future__ import annotations

import numpy as np

from .._shared.kernels import compiled

TILE_HEIGHT = 48
TILE_WIDTH = 64

MIN_SQUARED_NORMS = 1e-3
"""Of the product of the squared norms: below it a descriptor is the mean."""


@compiled(nogil=True, fastmath=True)
def describe_tiles(  # type: ignore[no-untyped-def]
    first,
    last,
    magnitude,
    orientation,
    columns,
    rows,
    order,
    starts,
    tiles_across,
    taps,
    spans,
    out,
):
    """Describe the keypoints of the tiles from `first` to before `last`.

    Args:
        first, last: numbers of the tiles, row by row.
        magnitude, orientation: (H, W) float32 gradient; orientation in units of 45 degrees.
        columns, rows: (N,) int32 keypoints.
        order: (N,) keypoints sorted by tile; `starts[k]` is where those of tile k begin.
        tiles_across: tiles in a row of them.
        taps: (4, T) float32 weights of the T pixels around a keypoint for each of four bins.
        spans: (4, 2) first tap and end of the taps of each bin that are not 0.
        out: (N, 128) uint8, written.
    """
    height, width = magnitude.shape
    reach = taps.shape[1] // 2
    soft = np.zeros((TILE_WIDTH + 2 * reach, 8), np.float32)
    summed = np.zeros((TILE_HEIGHT + 2 * reach, TILE_WIDTH, 32), np.float32)
    histogram = np.zeros((4, 32), np.float32)
    line = np.zeros(8, np.float32)
    needed = np.zeros(TILE_WIDTH, np.bool_)
    for tile in range(first, last):
        if starts[tile] == starts[tile + 1]:
            continue
        top = (tile // tiles_across) * TILE_HEIGHT
        left = (tile % tiles_across) * TILE_WIDTH
        needed[:] = False
        lowest, highest = TILE_HEIGHT, -1
        for k in order[starts[tile] : starts[tile + 1]]:
            needed[columns[k] - left] = True
            lowest, highest = min(lowest, rows[k] - top), max(highest, rows[k] - top)
        for j in range(lowest, highest + 2 * reach + 1):
            y = top + j - reach
            if y < 1 or y >= height - 1:
                summed[j] = 0
                continue
            soft[:] = 0
            for i in range(max(0, reach + 1 - left), min(len(soft), width - 1 + reach - left)):
                turn = orientation[y, left + i - reach]
                whole = int(turn)
                part = turn - np.float32(whole)
                weight = magnitude[y, left + i - reach]
                soft[i, whole & 7] = weight * (np.float32(1) - part)
                soft[i, (whole + 1) & 7] = weight * part
            for i in range(TILE_WIDTH):
                if not needed[i]:
                    continue
                for b in range(4):
                    line[:] = 0
                    for t in range(spans[b, 0], spans[b, 1]):
                        for o in range(8):
                            line[o] += taps[b, t] * soft[i + t, o]
                    for o in range(8):
                        summed[j, i, 8 * b + o] = line[o]
        for k in order[starts[tile] : starts[tile + 1]]:
            j, i = rows[k] - top, columns[k] - left
            for b in range(4):
                histogram[b] = 0
                for t in range(spans[b, 0], spans[b, 1]):
                    for o in range(32):
                        histogram[b, o] += taps[b, t] * summed[j + t, i, o]
            _normalise(histogram, out[k])


@compiled(nogil=True, fastmath=True, inline="always")
def _normalise(histogram, out):  # type: ignore[no-untyped-def]
    """Clip at a fifth of the norm, scale to 512 and round, as Lowe and OpenCV do."""
    total = np.float32(0)
    for b in range(4):
        for o in range(32):
            total += histogram[b, o] * histogram[b, o]
    most = np.sqrt(total) * np.float32(0.2)
    total = np.float32(0)
    for b in range(4):
        for o in range(32):
            histogram[b, o] = min(histogram[b, o], most)
            total += histogram[b, o] * histogram[b, o]
    scale = np.float32(512) / max(np.sqrt(total), np.float32(1.1920929e-07))
    for b in range(4):
        for o in range(32):
            out[32 * b + o] = np.uint8(min(np.float32(255), np.rint(histogram[b, o] * scale)))


@compiled(nogil=True)
def square_root(first, last, descriptors):  # type: ignore[no-untyped-def]
    """Convert SIFT to RootSIFT in place: 512 times the root of each number over the sum."""
    for k in range(first, last):
        total = 0
        for d in range(128):
            total += descriptors[k, d]
        scale = np.float32(512) / np.sqrt(np.float32(max(total, 1)))
        for d in range(128):
            value = np.rint(scale * np.sqrt(np.float32(descriptors[k, d])))
            descriptors[k, d] = np.uint8(min(np.float32(255), value))


# No full fastmath: its approximate division and root do not give 0 for equal descriptors.
@compiled(nogil=True, fastmath={"reassoc", "nsz", "contract"})
def correlation_distances(start, stop, first, rows0, second, rows1, mean, out):  # type: ignore[no-untyped-def]
    """Write 1 - correlation of the pairs from `start` to before `stop` into `out`."""
    for k in range(start, stop):
        a, b = first[rows0[k]], second[rows1[k]]
        both = np.float32(0)
        one = np.float32(0)
        other = np.float32(0)
        for d in range(len(mean)):
            x = np.float32(a[d]) - mean[d]
            y = np.float32(b[d]) - mean[d]
            both += x * y
            one += x * x
            other += y * y
        out[k] = np.float32(1) - both / np.sqrt(max(one * other, np.float32(MIN_SQUARED_NORMS)))
