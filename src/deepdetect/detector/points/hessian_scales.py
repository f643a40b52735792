"""Scale space of an image, and its candidates for keypoints: maxima of |det Hessian|."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.machine import parallel_for
from ..._shared.opencv import cv2
from ...features.selection import peak_offset

NMS_RADIUS = 2
"""A candidate is the maximum of a window of 5x5 in its level."""

SIGMAS_PX = 1.5 * 1.35 ** np.arange(-1.0, 9)
"""Of the Gaussians of all levels, in pixels: seven that have candidates, and one finer and two
coarser ones, which only the ranking looks at."""

LEAST_RESPONSE = 1e-8
"""Of a candidate, in an image with values in [0, 1]: less is rounding."""

PIXELS_AT_ONCE = 1 << 14
"""Derivatives of so many are computed together: they stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class ScaleSpace:
    """Smoothed copies of an image in [0, 1], with derivatives normalised by their scale.

    All but the sigmas are (L, H, W) float32. `determinant` and `trace` are the Hessian's, the
    gradient is squared, `highest` is the largest |determinant| within `NMS_RADIUS` in x and y.
    """

    sigmas_px: np.ndarray
    smooth: np.ndarray
    determinant: np.ndarray
    trace: np.ndarray
    gradient: np.ndarray
    highest: np.ndarray


@dataclass(frozen=True, eq=False)
class Candidates:
    """Maxima of |det Hessian| in each level of a scale space, with sub-pixel positions `xy`."""

    level: np.ndarray
    row: np.ndarray
    column: np.ndarray
    xy: np.ndarray
    sigma_px: np.ndarray

    def __len__(self) -> int:
        return len(self.level)

    def strength(self, space: ScaleSpace) -> np.ndarray:
        """Return |det Hessian| sigma^4 of each, (N,) float32."""
        return np.abs(space.determinant[self.level, self.row, self.column])

    def __getitem__(self, rows: np.ndarray) -> Candidates:
        """Return some of them, by a mask or by rows."""
        parts = (self.level, self.row, self.column, self.xy, self.sigma_px)
        return Candidates(*(part[rows] for part in parts))


def build_scale_space(gray: np.ndarray) -> ScaleSpace:
    """Smooth a (H, W) uint8 image at all scales, and differentiate it."""
    maps = [np.empty((len(SIGMAS_PX), *gray.shape), np.float32) for _ in range(5)]
    smooth, determinant, trace, gradient, highest = maps
    window = np.ones((2 * NMS_RADIUS + 1,) * 2, np.uint8)
    strength = np.empty(gray.shape, np.float32)
    current, reached = gray.astype(np.float32) / np.float32(255), 0.0
    for k, sigma in enumerate(SIGMAS_PX):
        # Gaussians add up by their variances: each level smooths the one before.
        current = cv2.GaussianBlur(current, (0, 0), float(np.sqrt(sigma**2 - reached**2)))
        reached = sigma
        smooth[k] = current
        parallel_for(
            gray.shape[0],
            _differentiate,
            cv2.copyMakeBorder(current, 1, 1, 1, 1, cv2.BORDER_REFLECT_101),
            np.float32(sigma**2),
            *(maps[k] for maps in (determinant, trace, gradient)),
            strength,
        )
        cv2.dilate(strength, window, dst=highest[k])
    return ScaleSpace(SIGMAS_PX, smooth, determinant, trace, gradient, highest)


def _differentiate(
    start: int,
    stop: int,
    padded: np.ndarray,
    variance: np.float32,
    determinant: np.ndarray,
    trace: np.ndarray,
    gradient: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Compute the derivatives of rows `start` to before `stop`, by central differences.

    The smoothed image has a border of one pixel. Determinant, trace and squared gradient, which are
    normalised by the variance, and |determinant| are written.
    """
    step = max(1, PIXELS_AT_ONCE // determinant.shape[1])
    for first in range(start, stop, step):
        rows = slice(first, min(first + step, stop))
        near = padded[first : rows.stop + 2]
        above, here, below = near[:-2, 1:-1], near[1:-1, 1:-1], near[2:, 1:-1]
        # In this order: the differences are small, so that little is rounded.
        xx = (near[1:-1, :-2] - 2 * here) + near[1:-1, 2:]
        yy = (above - 2 * here) + below
        dx, dy = near[:, 2:] - near[:, :-2], below - above
        xy = dx[2:] - dx[:-2]
        trace[rows] = (xx + yy) * variance
        determinant[rows] = (xx * yy - xy * xy * np.float32(1 / 16)) * (variance * variance)
        strength[rows] = np.abs(determinant[rows])
        dx = dx[1:-1]
        gradient[rows] = (dx * dx + dy * dy) * (variance * np.float32(1 / 4))


def find_candidates(space: ScaleSpace) -> Candidates:
    """Find the maxima of |det Hessian| of each level but the finest and the two coarsest.

    Their positions are refined by a parabola in x and in y. There are none in the outermost rows
    and columns.
    """
    found, positions = [], []
    for k in range(1, len(space.sigmas_px) - 2):
        response = np.abs(space.determinant[k])
        peak = (response == space.highest[k]) & (response > LEAST_RESPONSE)
        row, column = np.add(np.nonzero(peak[1:-1, 1:-1]), 1)
        x = column + peak_offset(response, row, column, axis=1)
        y = row + peak_offset(response, row, column, axis=0)
        found.append(np.stack([np.full(len(row), k), row, column]))
        positions.append(np.stack([x, y], 1))
    level, row, column = np.concatenate(found, 1)
    return Candidates(level, row, column, np.concatenate(positions), space.sigmas_px[level])
