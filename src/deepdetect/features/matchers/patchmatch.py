"""PatchMatch on the grid of keypoints: a neighbour's match, moved along, is probably a good one.

Barnes et al., "PatchMatch: A Randomized Correspondence Algorithm for Structural Image Editing",
2009, with two neighbours each and descriptors in place of patches. It takes a twentieth of FLANN's
time on hundreds of thousands of dense keypoints, and finds more correct matches there: a correct
one spreads to those around it. It does not suit few or scattered keypoints.
"""

from __future__ import annotations

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.parallel import parallel_for
from ..keypoints import on_pixels

SWEEPS = 4
"""Over all queries, down and up in turn."""

OFFSETS_PX = (1, 4, 12)
"""Distances to the queries whose neighbours are tried; one pixel where keypoints are dense."""

BAND_HEIGHT_PX = 96
"""Of a part that one thread works on; the result depends on it."""

SEARCH_SHRINK = 3
"""Random tries begin in the whole image around the best neighbour; each next one is so many times
nearer."""


def patchmatch_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find two approximate nearest neighbours of each query by spreading good ones.

    A `Matcher` of bytes on whole pixels; the result is the same for any number of threads.

    Raises:
        OptionError: the descriptors are not bytes, or the keypoints are not on whole pixels or have
            scales of their own.
    """
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher patchmatch needs descriptors of bytes, such as sift and rootsift: use "
            "flann, faiss or exact"
        )
    if positions is None:
        raise OptionError(
            "the matcher patchmatch needs dense keypoints of one scale and angle, not points with "
            "their own: use auto, flann, faiss or exact"
        )
    if count > 2 or len(base) < 2:
        raise OptionError("the matcher patchmatch finds one or two neighbours, of two or more")
    from . import patchmatch_kernel as kernel

    xy0, xy1 = (_pixels(xy) for xy in positions)
    # In row-major order: a sweep builds on what it has just found.
    order = _row_major_order(xy0)
    if order is not None:
        queries, xy0 = queries[order], xy0[order]
    at0, at1 = _grid(xy0), _grid(xy1)
    edges = np.arange(0, at0.shape[0] + BAND_HEIGHT_PX, BAND_HEIGHT_PX)
    bands = np.searchsorted(xy0[:, 1], edges)
    rows = np.empty((len(queries), 2), np.int32)
    distances = np.empty((len(queries), 2), np.int32)
    offsets, radii = np.array(OFFSETS_PX), _radii(max(at1.shape))
    parallel_for(len(queries), kernel.start, queries, base, seed, rows, distances)
    images = queries, base, xy0, xy1, at0, at1
    for turn in range(SWEEPS):
        tries = offsets, turn, seed, radii
        found = rows.copy(), rows, distances
        parallel_for(len(bands) - 1, kernel.sweep, bands, *images, *tries, *found)
    gaps = np.sqrt(distances.astype(np.float32))
    if order is not None:
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        rows, gaps = rows[back], gaps[back]
    return rows[:, :count], gaps[:, :count]


def _row_major_order(pixels: np.ndarray) -> np.ndarray | None:
    """Return the rows by lines and columns; None when they are sorted, as of most detectors."""
    number = pixels[:, 1].astype(np.int64) * (int(pixels[:, 0].max()) + 1) + pixels[:, 0]
    return None if (number[1:] >= number[:-1]).all() else np.argsort(number, kind="stable")


def _pixels(xy: np.ndarray) -> np.ndarray:
    if not on_pixels(xy):
        raise OptionError(
            "the matcher patchmatch needs keypoints on whole pixels: use flann, faiss or exact"
        )
    return np.asarray(xy).astype(np.int32)


def _grid(xy: np.ndarray) -> np.ndarray:
    """Return the row at each pixel of the smallest image that holds all, -1 where there is none."""
    width, height = xy.max(axis=0) + 1
    grid = np.full((height, width), -1, np.int32)
    grid[xy[:, 1], xy[:, 0]] = np.arange(len(xy))
    return grid


def _radii(longest_side: int) -> np.ndarray:
    radii = [longest_side // 2]
    while radii[-1] > SEARCH_SHRINK:
        radii.append(radii[-1] // SEARCH_SHRINK)
    return np.maximum(radii, 1)
