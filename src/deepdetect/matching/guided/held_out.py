"""Evidence that played no part in matching: windows whose own matches are held out.

The matches of the windows around one predict, by an affine map, where it is seen in the second
image. Right matches predict what looks alike there; what was matched by chance does not.
"""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.images import BLUR_SIGMA_PX, downscale, gaussian_blur, local_zncc
from ...geometry.transforms import scaled_points
from .initial_geometry import Pair

COMPARED_SIDE_PX = 640
"""Longer side to which images are reduced."""

WINDOW_PX = 16
"""Side of the windows, which divide the first image."""

MIN_AROUND = 5
"""Of the eight windows around one, those with matches, for them to predict where it is seen."""

MIN_WINDOWS = 20
"""With fewer that can be compared nothing is known."""

FALSE_POSITIVE_RATE = 0.05
"""Fraction of the unrelated windows that are as much alike, with those around them, as those of
matches that the images do not contradict."""


def compare_held_out(
    grays: Pair, points0: np.ndarray, points1: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compare windows of two images where the matches around them, (M, 2) each, say.

    Returns their median correlation, 0 where too few can be compared, and (M,) bool: false for the
    matches whose own window is no more alike than unrelated ones.
    """
    (first, scale0), (second, scale1) = (downscale(gray, COMPARED_SIDE_PX) for gray in grays)
    points0, points1 = scaled_points(points0, scale0), scaled_points(points1, scale1)
    rows, columns = (side // WINDOW_PX for side in first.shape)
    everything = np.ones(len(points0), bool)
    if 0 in (rows, columns):
        return 0.0, everything
    first = gaussian_blur(first[: rows * WINDOW_PX, : columns * WINDOW_PX], BLUR_SIGMA_PX)
    last = np.array([columns, rows]) - 1
    column, row = ((points0 + 0.5) // WINDOW_PX).astype(np.int64).clip(0, last).T
    affine, known = _affine_maps(row * columns + column, points0, points1, (rows, columns))
    terms = affine.repeat(WINDOW_PX, 0).repeat(WINDOW_PX, 1)
    y, x = np.indices(first.shape)
    x1, y1 = (terms[..., 0, k] * x + terms[..., 1, k] * y + terms[..., 2, k] for k in (0, 1))
    inside = (x1 >= 0) & (x1 <= second.shape[1] - 1) & (y1 >= 0) & (y1 <= second.shape[0] - 1)
    inside &= known.repeat(WINDOW_PX, 0).repeat(WINDOW_PX, 1)
    blurred = gaussian_blur(second, BLUR_SIGMA_PX)
    seen = cv2.remap(blurred, x1.astype(np.float32), y1.astype(np.float32), cv2.INTER_LINEAR)
    own = local_zncc(first, seen, inside, WINDOW_PX, WINDOW_PX)
    shift = rows // 2 * WINDOW_PX, columns // 2 * WINDOW_PX
    others, shown = (np.roll(values, shift, (0, 1)) for values in (seen, inside))
    unrelated = local_zncc(first, others, shown, WINDOW_PX, WINDOW_PX)
    if min(np.isfinite(own).sum(), np.isfinite(unrelated).sum()) < MIN_WINDOWS:
        return 0.0, everything
    bound = np.nanquantile(_mean_around(unrelated), 1 - FALSE_POSITIVE_RATE)
    alike = ~(_mean_around(own) <= bound)  # or not known
    return float(np.nanmedian(own)), alike[row, column]


def _mean_around(values: np.ndarray) -> np.ndarray:
    """Average windows with those around them, (rows, columns); NaN where one is not known."""
    known = np.isfinite(values)
    total, count = (
        cv2.boxFilter(part, cv2.CV_64F, (3, 3), borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0), known.astype(np.float32))
    )
    return np.where(known, total / np.maximum(count, 1e-9), np.nan)


def _affine_maps(
    windows: np.ndarray, points0: np.ndarray, points1: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit an affine map, (3, 2), to the matches of the windows around each of (rows, columns).

    By the number of the window of each match. Returns where there is one, too, (rows, columns).
    """
    size = shape[0] * shape[1]

    def around(own: np.ndarray) -> np.ndarray:
        own = own.reshape(shape).astype(np.float64)
        box = cv2.boxFilter(own, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(box - own)

    left = np.column_stack([points0, np.ones(len(points0))])
    squares, products = (
        np.array([[around(np.bincount(windows, a * b, size)) for b in right.T] for a in left.T])
        for right in (left, points1)
    )
    known = around(np.bincount(windows, minlength=size) > 0) >= MIN_AROUND
    affine = np.zeros((*shape, 3, 2))
    affine[known] = np.linalg.solve(
        np.moveaxis(squares[..., known], -1, 0), np.moveaxis(products[..., known], -1, 0)
    )
    return affine, known
