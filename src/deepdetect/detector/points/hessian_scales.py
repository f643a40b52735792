"""Scale space of an image, and its candidates for keypoints: maxima of |det Hessian|."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..._shared.opencv import cv2
from ...features.selection import descending_order, peak_offset

NMS_RADIUS = 2
"""A candidate has the highest |det Hessian| within this many pixels in x and y. Chosen by hand."""

SIGMAS_PX = 1.5 * 1.35 ** np.arange(-1.0, 9)
"""Sigmas of the Gaussians of all levels, in pixels, from fine to coarse. Seven levels have
candidates. The finest and the two coarsest only serve the ranker's features. Chosen by hand."""

VARIANCES = (SIGMAS_PX**2).astype(np.float32)
"""Squares of `SIGMAS_PX`, which normalise the derivatives."""

LEAST_RESPONSE = 1e-8
"""Minimum |det Hessian| of a candidate, for grey values in [0, 1]: less is rounding error."""


@dataclass(frozen=True, eq=False)
class ScaleSpace:
    """Smoothed copies of an image with values in [0, 1], and the determinants of their Hessians.

    `gray` is the mean of the image, rounded to a multiple of 1/255. `smooth` holds the copies minus
    `gray`, and `determinant` the scale-normalised determinants. Both are (L, H, W) float32.
    """

    gray: np.float32
    smooth: np.ndarray
    determinant: np.ndarray


@dataclass(frozen=True, eq=False)
class Candidates:
    """Maxima of |det Hessian| in each level of a scale space.

    Attributes:
        level, row, column: (N,) int64 level of the scale space, and pixel in it.
        xy: (N, 2) float64 sub-pixel positions in the image.
        sigma_px: (N,) float64 sigmas of the candidates' levels.
        rank: (N,) int64 ranks by scale-normalised |det Hessian|; 0 is the strongest of all levels.
    """

    level: np.ndarray
    row: np.ndarray
    column: np.ndarray
    xy: np.ndarray
    sigma_px: np.ndarray
    rank: np.ndarray

    def __len__(self) -> int:
        return len(self.level)

    def __getitem__(self, rows: np.ndarray) -> Candidates:
        """Return the candidates chosen by a mask or by row indices."""
        return Candidates(*(getattr(self, field.name)[rows] for field in fields(self)))


def build_scale_space(gray: np.ndarray) -> ScaleSpace:
    """Smooth a (H, W) uint8 image with all sigmas, and compute the determinants of the Hessian."""
    from .kernels import differentiate

    smooth, determinant = (np.empty((len(SIGMAS_PX), *gray.shape), np.float32) for _ in range(2))
    # Subtracting the mean brings values close to 0, where float32 rounds least. With less rounding,
    # other implementations, such as the ONNX graph, find the same maxima.
    mean = np.float32(np.rint(gray.mean()))
    space = ScaleSpace(mean / np.float32(255), smooth, determinant)
    current, reached = (gray - mean) / np.float32(255), 0.0
    for k, sigma in enumerate(SIGMAS_PX):
        # The variances of Gaussians add up: each level smooths the previous one.
        step = float(np.sqrt(sigma**2 - reached**2))
        current, reached = cv2.GaussianBlur(current, (0, 0), step, dst=smooth[k]), sigma
        differentiate(smooth[k], VARIANCES[k], determinant[k])
    return space


def find_candidates(space: ScaleSpace) -> Candidates:
    """Find the maxima of |det Hessian| in each level except the finest and the two coarsest.

    Positions are refined by parabolas in x and y. The outermost pixels are not searched.
    """
    pixels, positions, strengths = [], [], []
    window = np.ones((2 * NMS_RADIUS + 1,) * 2, np.uint8)
    for k in range(1, len(SIGMAS_PX) - 2):
        response = np.abs(space.determinant[k])
        peak = (response == cv2.dilate(response, window)) & (response > LEAST_RESPONSE)
        row, column = np.add(np.divmod(np.flatnonzero(peak[1:-1, 1:-1]), response.shape[1] - 2), 1)
        x = column + peak_offset(response, row, column, axis=1)
        y = row + peak_offset(response, row, column, axis=0)
        pixels.append(np.stack([np.full(len(row), k), row, column]))
        positions.append(np.stack([x, y], 1))
        strengths.append(response[row, column])
    level, row, column = np.concatenate(pixels, 1)
    strength = np.concatenate(strengths)
    rank = np.empty(len(level), np.int64)
    rank[descending_order(strength)] = np.arange(len(level))
    xy = np.concatenate(positions)
    return Candidates(level, row, column, xy, SIGMAS_PX[level], rank)
