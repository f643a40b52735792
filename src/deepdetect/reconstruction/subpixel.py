"""Refine matches to sub-pixel accuracy: align the patch around each point to the second image.

Each patch is aligned twice by `align_patches`, first warped by a similarity fitted to all matches,
then by an affinity fitted to the refined matches around it. On Middlebury's Motorcycle, 65 % of the
converged matches were accurate to 0.25 px.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._shared.opencv import cv2
from ..geometry.alignment import Alignment, align_patches
from ..geometry.images import window_sums

PATCH_RADIUS_PX = 4
"""The side of a patch is 2 * radius + 1 pixels, and its pixels have Gaussian weights with a sigma
of radius / 2. Chosen by hand."""

MAX_SHIFT_PX = 2.0
"""A match may move by at most this distance in each of the two alignments. Chosen by hand."""

CONVERGENCE_PX, COARSE_CONVERGENCE_PX = 0.01, 0.05
"""The first alignment ends at a step shorter than COARSE_CONVERGENCE_PX, because it only prepares
the second. The second ends at a step shorter than CONVERGENCE_PX."""

AFFINITY_WINDOW_PX = 15
"""The affinity of a patch is fitted to the matches in a window with this side. Chosen by hand."""

AFFINITY_REGULARIZATION = 20.0
"""When an affinity is fitted to the matches in a window, the similarity of all matches counts as
much as this number of matches, in case the matches are few or on one line. Chosen by hand."""

MAX_SIMILARITY_SAMPLES, SIMILARITY_ITERATIONS = 5000, 20
"""Limits of the robust similarity fit: number of matches, evenly sampled, and of iterations."""

CORNER_WINDOW_PX = 7
"""Side of the window in which the strength of a corner is measured, about that of a patch."""


def refine_dense(
    gray0: np.ndarray, gray1: np.ndarray, points0: np.ndarray, points1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Refine the (N, 2) positions of matches in the second image to sub-pixel accuracy.

    The positions in the second image must be accurate to a pixel or two. Those in the first image
    are rounded to whole pixels. Returns the refined positions, (N, 2) float64, and (N,) bool, True
    for matches that converged. A match does not converge if its patch is flat, crosses the border,
    moves too far or stays too different. Alignments that do not converge change no positions.
    """
    pixels0 = np.rint(points0).astype(np.int64)
    start = np.array(points1, np.float64, order="C")
    inside = np.asarray(((start >= 0) & (start < gray1.shape[::-1])).all(axis=1))
    if not inside.all():
        start[inside], inside[inside] = refine_dense(gray0, gray1, pixels0[inside], start[inside])
        return start, inside
    if not len(pixels0):
        return start, inside
    images = gray0.astype(np.float32), gray1.astype(np.float32)
    overall = similarity(pixels0, start)
    affinities = np.broadcast_to(overall, (len(start), 2, 2))
    coarse = Alignment(PATCH_RADIUS_PX, MAX_SHIFT_PX, COARSE_CONVERGENCE_PX)
    found = align_patches(images, pixels0, start, affinities, coarse)
    start, converged = found.points1, found.converged
    affinities = local_affinities(pixels0, start, converged, gray0.shape, overall)
    fine = replace(coarse, convergence_px=CONVERGENCE_PX)
    found = align_patches(images, pixels0, start, affinities, fine)
    return found.points1, found.converged


def spread_corners(gray: np.ndarray, points: np.ndarray, count: int) -> np.ndarray:
    """Return indices of the (N, 2) pixels that are the best corners of about `count` squares."""
    column, row = np.asarray(points, np.int64).reshape(-1, 2).T
    strength = cv2.cornerMinEigenVal(gray, CORNER_WINDOW_PX)[row, column]
    side = np.sqrt(gray.size / count)
    across, down = (np.floor(values / side).astype(np.int64) for values in (column, row))
    cell = down * (gray.shape[1] + 1) + across
    order = np.lexsort((-strength, cell))
    return np.sort(order[np.flatnonzero(np.diff(cell[order], prepend=-1))])


def similarity(points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
    """Return rotation times scale, (2, 2), of a similarity fitted robustly to all matches."""
    every = -(-len(points0) // MAX_SIMILARITY_SAMPLES)
    z0, z1 = (points[::every].astype(np.float64) @ [1, 1j] for points in (points0, points1))
    weights, factor = np.ones(len(z0)), complex(1)
    # The sum of distances is minimised: it has one minimum, and a few outliers change it little.
    for _ in range(SIMILARITY_ITERATIONS if len(z0) >= 3 else 0):
        first, second = (z - np.average(z, weights=weights) for z in (z0, z1))
        held = first * weights
        factor = complex(np.vdot(held, second) / (np.vdot(held, first) + 1e-9))
        weights = 1 / np.maximum(np.abs(second - factor * first), 1e-3)
    return np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])


def local_affinities(
    pixels0: np.ndarray,
    points1: np.ndarray,
    converged: np.ndarray,
    shape: tuple[int, ...],
    overall: np.ndarray,
) -> np.ndarray:
    """Fit an affinity to the converged matches in the window around each match.

    Returns (N, 2, 2) float32 matrices from the first image to the second. If the matches
    around a match are few or badly spread, its matrix is close to `overall`, the (2, 2) matrix of
    the similarity of all matches. `shape` is (H, W) of the first image.
    """
    pixels0 = np.asarray(pixels0, np.int64)
    column, row = pixels0.T
    # Positions are relative to the image centre: sums of large squares would lose precision.
    across, down = column - shape[1] / 2, row - shape[0] / 2
    rest = points1 - np.column_stack([across, down]) @ overall.T
    size = AFFINITY_WINDOW_PX

    def sums(values: np.ndarray) -> np.ndarray:
        return window_sums(pixels0[converged], values[converged], shape, size, at=pixels0)

    count, sum_x, sum_y = sums(np.ones(len(row))), sums(across), sums(down)
    count = np.maximum(np.rint(count), 1)
    ridge = AFFINITY_REGULARIZATION * (size**2 - 1) / 12
    xx = sums(across**2) - sum_x**2 / count + ridge
    yy = sums(down**2) - sum_y**2 / count + ridge
    xy = sums(across * down) - sum_x * sum_y / count
    result = np.empty((len(column), 2, 2))
    for axis in range(2):
        values = rest[:, axis]
        mean = sums(values) / count
        by_x = sums(across * values) - sum_x * mean
        by_y = sums(down * values) - sum_y * mean
        result[:, axis, 0] = (yy * by_x - xy * by_y) / (xx * yy - xy**2)
        result[:, axis, 1] = (xx * by_y - xy * by_x) / (xx * yy - xy**2)
    return (result + overall).astype(np.float32)
