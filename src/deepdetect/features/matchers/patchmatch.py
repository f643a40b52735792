"""Coherent search on the grid of keypoints: what fits a pixel's neighbour probably fits it too.

PatchMatch (Barnes et al., "PatchMatch: A Randomized Correspondence Algorithm for Structural Image
Editing", 2009), with two neighbours each and descriptors in place of patches. It takes a twentieth
of FLANN's time on hundreds of thousands of dense keypoints, and finds more right matches there: a
right one spreads to those around it. On few or scattered keypoints it has nothing to go by.
"""

from __future__ import annotations

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.parallel import parallel_for

SWEEPS = 4
OFFSETS = (1, 4, 12)
"""Pixels to the queries whose neighbours are tried; one holds where keypoints are dense."""

BAND = 96
"""Height in pixels of a part that is done by one thread; the result depends on it."""

TRIES = 16
"""Random places on its epipolar line that a query begins with."""

SHRINK = 3
"""Random tries begin with the whole image around the best, each then so many times nearer."""


def patchmatch_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find two near neighbours of each query by spreading good ones over the image.

    Args:
        queries: (N, D) uint8 descriptors.
        base: (M, D) uint8 descriptors, M >= 2.
        count: neighbours of each query, 1 or 2.
        seed: of the random tries; the result is the same for the same seed, whatever the
            number of threads.
        positions: (N, 2) and (M, 2) pixels of the keypoints.

    Returns:
        (N, count) int32 rows of `base` and (N, count) float32 Euclidean distances, the nearest
        first. The search is approximate.

    Raises:
        OptionError: the descriptors are not bytes, or the keypoints are not on whole pixels.
    """
    if queries.dtype != np.uint8 or base.dtype != np.uint8 or positions is None:
        raise OptionError(
            "the matcher patchmatch takes descriptors of bytes, as sift's and rootsift's, with "
            "their positions: take flann, faiss or exact"
        )
    if count > 2 or len(base) < 2:
        raise OptionError("the matcher patchmatch finds one or two neighbours, of two or more")
    return _search(queries, base, count, seed, positions, None, np.inf)


def epipolar_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    seed: int,
    positions: tuple[np.ndarray, np.ndarray],
    fundamental: np.ndarray,
    band: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbour of each query near its epipolar line.

    Args:
        queries, base, seed, positions: as of `patchmatch_neighbours`.
        fundamental: (3, 3) with x1^T F x0 = 0.
        band: a neighbour is at most so far from the line, in pixels.

    Returns:
        (N,) int32 rows of `base` and (N,) float32 distances, infinite where none was found.
    """
    rows, distances = _search(queries, base, 1, seed, positions, fundamental, band)
    return rows[:, 0], distances[:, 0]


def _search(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: tuple[np.ndarray, np.ndarray],
    fundamental: np.ndarray | None,
    band: float,
) -> tuple[np.ndarray, np.ndarray]:
    from . import patchmatch_kernel as kernel

    pixels = [_pixels(xy) for xy in positions]
    # In the order of reading: a sweep builds on what it has just found.
    order = _order_of_reading(pixels[0])
    if order is not None:
        queries, pixels[0] = queries[order], pixels[0][order]
    at0, at1 = (_grid(xy) for xy in pixels)
    edges = np.arange(0, at0.shape[0] + BAND, BAND)
    bands = np.searchsorted(pixels[0][:, 1], edges)
    rows = np.empty((len(queries), 2), np.int32)
    distances = np.empty((len(queries), 2), np.int32)
    matrix = np.zeros((3, 3)) if fundamental is None else np.asarray(fundamental, np.float64)

    def begin(first: int, last: int) -> None:
        if fundamental is None:
            kernel.start(first, last, queries, base, seed, rows, distances)
        else:
            kernel.start_on_lines(
                first, last, queries, base, pixels[0], at1, matrix, TRIES, seed, rows, distances
            )

    parallel_for(len(queries), begin)
    for turn in range(SWEEPS):
        before = rows.copy()

        def work(first: int, last: int, turn: int = turn, before: np.ndarray = before) -> None:
            kernel.sweep(
                *(first, last, bands, queries, base, *pixels, at0, at1, np.array(OFFSETS), turn),
                *(seed, _radii(at1.shape), before, rows, distances, matrix, float(band)),
            )

        parallel_for(len(bands) - 1, work)
    gaps = np.sqrt(distances.astype(np.float32))
    gaps[distances == kernel.FAR] = np.inf
    if order is not None:
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        rows, gaps = rows[back], gaps[back]
    return rows[:, :count], gaps[:, :count]


def _order_of_reading(pixels: np.ndarray) -> np.ndarray | None:
    """Return the rows by lines and columns; None when they stand so already, as detectors do."""
    number = pixels[:, 1].astype(np.int64) * (int(pixels[:, 0].max()) + 1) + pixels[:, 0]
    return None if (number[1:] >= number[:-1]).all() else np.argsort(number, kind="stable")


def _pixels(xy: np.ndarray) -> np.ndarray:
    xy = np.asarray(xy)
    pixels = np.rint(xy).astype(np.int32)
    if (pixels != xy).any() or (pixels < 0).any():
        raise OptionError(
            "the matcher patchmatch takes keypoints on whole pixels: take flann, faiss or exact"
        )
    return pixels


def _grid(xy: np.ndarray) -> np.ndarray:
    """Return the row at each pixel of the smallest image that holds all, -1 where there is none."""
    width, height = xy.max(axis=0) + 1
    grid = np.full((height, width), -1, np.int32)
    grid[xy[:, 1], xy[:, 0]] = np.arange(len(xy))
    return grid


def _radii(shape: tuple[int, ...]) -> np.ndarray:
    radii = [max(shape) // 2]
    while radii[-1] > SHRINK:
        radii.append(radii[-1] // SHRINK)
    return np.maximum(radii, 1)
