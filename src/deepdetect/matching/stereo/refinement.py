"""Sub-pixel disparities: Lucas-Kanade along the row, on smoothed surfaces.

A parabola through the costs of three whole disparities pulls towards whole pixels: on a smooth
surface that makes terraces. Here it only starts a least-squares fit of the grey values themselves
(Lucas and Kanade, "An iterative image registration technique", 1981), with gain and offset of the
light free in each window. Each pixel of a window is mapped to the right image by its own smoothed
disparity, so that slanted surfaces fit as well as those that face the camera, and pixels on the
other side of a disparity discontinuity do not count. Measured on the Motorcycle pair, on which the
constants were chosen (`benchmarks/row_matching.py`): 82 % of the disparities within 0.25 px of the
truth instead of the parabola's 73 %, and fractions as often near whole pixels as between them (each
tenth of a pixel 0.97 to 1.03 times as often as in the truth; with the parabola 0.45 to 2.00 times).
"""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2
from ..._shared.parallel import parallel_for
from .consistency import MAX_DIFFERENCE_PX

WINDOW_RADIUS_PX = 2
"""The fitted windows have 5 pixels a side."""

SMOOTHING_RADIUS_PX = 4
"""Of the mean of the same surface before each iteration: it undoes most of the parabola's pull."""

FINAL_SMOOTHING_RADIUS_PX = 2
"""Of the mean taken at the end."""

ITERATIONS = 2
"""Of the fit."""

NOISE_LEVELS = 2.0
"""Grey levels; where the image has no stronger gradients the smoothed surface stays."""

MIN_GAIN = 0.2
"""Least contrast of the right view over the left: below, it shows something else, and the disparity
stays."""


def refine_disparity(
    left: np.ndarray, right: np.ndarray, disparity: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Refine disparities to sub-pixel accuracy.

    Args:
        left, right: (H, W) uint8 luma of a rectified pair.
        disparity: (H, W) float32 in pixels, accurate to a pixel.
        known: (H, W) bool, where it is to be refined.

    Returns:
        (H, W) float32 disparity; unchanged where not known.

    Example:
        >>> import cv2
        >>> scene = np.random.default_rng(0).integers(0, 256, (40, 80), np.uint8)
        >>> scene = cv2.equalizeHist(cv2.GaussianBlur(scene, (0, 0), 2))
        >>> shift = np.float32([[1, 0, -3.5], [0, 1, 0]])
        >>> moved = cv2.warpAffine(scene, shift, (80, 40), flags=cv2.INTER_CUBIC)
        >>> start = np.full((40, 80), 3, np.float32)
        >>> refined = refine_disparity(scene, moved, start, start > 0)
        >>> bool(abs(np.median(refined[:, 10:-10]) - 3.5) < 0.05)
        True
    """
    from . import refinement_kernel as kernel

    gray, target = left.astype(np.float32), right.astype(np.float32)
    padded = _padded(gray, WINDOW_RADIUS_PX)
    limits = np.array([MAX_DIFFERENCE_PX, NOISE_LEVELS, MIN_GAIN], np.float32)
    refined = disparity
    for _ in range(ITERATIONS):
        start = _smoothed(refined, known, SMOOTHING_RADIUS_PX)
        values, gradient = np.empty_like(gray), np.empty_like(gray)
        parallel_for(len(gray), kernel.sample_rows, target, start, values, gradient)
        images = (
            padded,
            _padded(values, WINDOW_RADIUS_PX),
            _padded(gradient, WINDOW_RADIUS_PX),
            _padded(start, WINDOW_RADIUS_PX, known),
        )
        refined = np.empty_like(gray)
        parallel_for(len(gray), kernel.step_rows, *images, WINDOW_RADIUS_PX, *limits, refined)
    final = _smoothed(refined, known, FINAL_SMOOTHING_RADIUS_PX)
    return np.where(known, final, disparity)


def _smoothed(disparity: np.ndarray, known: np.ndarray, radius: int) -> np.ndarray:
    """Return the mean disparity of the same surface around each known pixel, 0 elsewhere."""
    from . import refinement_kernel as kernel

    out = np.empty_like(disparity)
    padded = _padded(disparity, radius, known)
    limit = np.float32(MAX_DIFFERENCE_PX)
    parallel_for(len(out), kernel.smooth_rows, padded, radius, limit, out)
    return np.where(known, out, np.float32(0))


def _padded(values: np.ndarray, radius: int, known: np.ndarray | None = None) -> np.ndarray:
    """Pad an image; disparities that are not known are marked, those of the border too."""
    from . import refinement_kernel as kernel

    border = 0.0
    if known is not None:
        border = float(kernel.UNKNOWN)
        values = np.where(known, values, kernel.UNKNOWN)
    sides = (radius, radius, radius, radius)
    return cv2.copyMakeBorder(values, *sides, cv2.BORDER_CONSTANT, value=border)
