"""Scale space of an image, and its candidates for keypoints: maxima of |det Hessian|."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..._shared.opencv import cv2
from ...features.selection import MAX_OFFSET_PX, descending_order

SIGMAS_PX = 1.5 * 1.35 ** np.arange(-1.0, 9)
"""Sigmas of the Gaussians of all levels, in pixels, from fine to coarse. Seven levels have
candidates. The finest and the two coarsest only serve the ranker's features. Chosen by hand."""

OCTAVES = np.log2(SIGMAS_PX / 3).clip(0).astype(np.int64)
"""A level of octave o has every 2^o-th pixel of every 2^o-th row, which saves time. Its sigma is at
least 3 of these pixels: on pairs made of photos/val, the mean repeatability of 2,048 keypoints
within 3 px is then 0.716, with at least 2 pixels 0.713, and with all pixels 0.717."""

NMS_RADII = np.where(OCTAVES > 0, 1, 2)
"""A candidate of a level has the highest |det Hessian| within this many of the level's pixels in x
and in y. In sampled levels, 1 is 2 or 4 pixels of the image. With 2, they have a quarter fewer
candidates, and of two pairs of KITTI that are far apart, 4 of 6 poses were wrong, not 0 of 6."""

ANGLE_OCTAVES = np.log2(SIGMAS_PX / 2).clip(0).astype(np.int64)
"""Orientations, which need less detail, are found from every 2^o-th pixel of the image."""

VARIANCES = ((SIGMAS_PX / 2.0**OCTAVES) ** 2).astype(np.float32)
"""Squares of the sigmas in pixels of their levels, which normalise the derivatives."""

LEAST_RESPONSE = 1e-8
"""Minimum |det Hessian| of a candidate, for grey values in [0, 1]: less is rounding error."""


@dataclass(frozen=True, eq=False)
class ScaleSpace:
    """Smoothed copies of an image with values in [0, 1], and |det Hessian| of each.

    Attributes:
        gray: mean of the image, rounded to a multiple of 1/255.
        smooth: float32 copies minus `gray`; all levels, one after the other.
        response: float32 scale-normalised |det Hessian| of the same pixels.
        layout: (L, 3) int64, for each level its first index in both arrays, its height and width.
    """

    gray: np.float32
    smooth: np.ndarray
    response: np.ndarray
    layout: np.ndarray

    def level(self, values: np.ndarray, number: int) -> np.ndarray:
        """Return a level of `smooth` or `response` as an image, (height, width)."""
        start, height, width = self.layout[number].tolist()
        return values[start : start + height * width].reshape(height, width)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Maxima of |det Hessian| in each level of a scale space.

    Attributes:
        level, row, column: (N,) int64 level of the scale space, and pixel of that level.
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

    @property
    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the candidates' pixels in the image."""
        return self.row << OCTAVES[self.level], self.column << OCTAVES[self.level]

    def __getitem__(self, rows: np.ndarray) -> Candidates:
        """Return the candidates chosen by a mask or by row indices."""
        return Candidates(*(getattr(self, field.name)[rows] for field in fields(self)))


def build_scale_space(gray: np.ndarray) -> ScaleSpace:
    """Smooth a (H, W) uint8 image with all sigmas, and compute the determinants of the Hessian."""
    from .kernels import differentiate

    sides = -(-np.array(gray.shape) // (1 << OCTAVES[:, None]))
    ends = np.cumsum(sides.prod(axis=1))
    layout = np.column_stack([ends - sides.prod(axis=1), sides])
    smooth, response = (np.empty(ends[-1], np.float32) for _ in range(2))
    # Subtracting the mean brings values close to 0, where float32 rounds least. With less rounding,
    # other implementations, such as the ONNX graph, find the same maxima.
    mean = np.float32(np.rint(gray.mean()))
    space = ScaleSpace(mean / np.float32(255), smooth, response, layout)
    current, octave, reached = (gray - mean) / np.float32(255), 0, 0.0
    for k, sigma in enumerate(SIGMAS_PX):
        if OCTAVES[k] > octave:
            current, octave = np.ascontiguousarray(current[::2, ::2]), OCTAVES[k]
        # The variances of Gaussians add up: each level smooths the previous one.
        step = float(np.sqrt(sigma**2 - reached**2)) / 2.0**octave
        out = space.level(smooth, k)
        current, reached = cv2.GaussianBlur(current, (0, 0), step, dst=out), sigma
        differentiate(current, VARIANCES[k], space.level(response, k))
    return space


def find_candidates(
    space: ScaleSpace, strongest: int | None = None, ignore: np.ndarray | None = None
) -> Candidates:
    """Find maxima of |det Hessian| in each level except the finest and the two coarsest.

    Positions are refined by paraboloids. The outermost pixels are not searched. Returns
    the `strongest` candidates (None: all) outside `ignore`, (H, W) bool, the strongest first.
    """
    from .kernels import mark_peaks, refine_peaks

    levels, starts, widths = range(1, len(SIGMAS_PX) - 2), space.layout[:, 0], space.layout[:, 2]
    found = []
    for k in levels:
        response = space.level(space.response, k)
        peak = np.zeros(response.shape, np.bool_)
        mark_peaks(response, NMS_RADII[k], np.float32(LEAST_RESPONSE), peak)
        found.append(np.flatnonzero(peak))
    level = np.repeat(levels, [len(each) for each in found])
    place = np.concatenate(found)
    if ignore is not None:
        row, column = np.divmod(place, widths[level])
        seen = ~ignore[row << OCTAVES[level], column << OCTAVES[level]]
        level, place = level[seen], place[seen]
    strength = space.response[starts[level] + place]
    if strongest is not None and len(place) > strongest:
        least = np.partition(strength, -strongest)[-strongest]
        some = strength >= least
        level, place, strength = level[some], place[some], strength[some]
    order = descending_order(strength)[:strongest]
    level, place = level[order], place[order]
    row, column = np.divmod(place, widths[level])
    pixels = np.column_stack([level, row, column])
    xy = np.empty((len(order), 2))
    refine_peaks(pixels, space.response, space.layout, OCTAVES, MAX_OFFSET_PX, xy)
    return Candidates(level, row, column, xy, SIGMAS_PX[level], np.arange(len(order)))
