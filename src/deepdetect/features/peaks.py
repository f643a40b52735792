"""Local maxima of maps: which pixels are, and where they are to a fraction of a pixel."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2
from .keypoints import bayer_order

MAX_OFFSET_PX = 0.499
"""The nearest pixel of a refined keypoint is still the one that it was found at."""


def highest_in_window(
    pixels: np.ndarray,
    scores: np.ndarray,
    shape: tuple[int, ...],
    radius: int,
    first_row: int,
    height: int,
) -> np.ndarray:
    """Return which pixels of a band rank highest in the window around them.

    The band has this shape, and begins with this row of an image of this height.

    Of equal scores the one that comes first in `bayer_order` ranks higher: one pixel of a plateau
    is kept.
    """
    kind = np.float32 if scores.dtype == np.float32 else np.float64
    image = np.full(shape, -np.inf, kind)
    image.ravel()[pixels] = np.maximum(scores, np.finfo(kind).min)
    window = np.ones((2 * radius + 1,) * 2, np.uint8)  # a box is dilated in linear time
    highest = cv2.dilate(image, window) == image  # beyond the border is -infinity
    kept = highest.ravel()[pixels]
    rows = np.flatnonzero(kept)
    row, column = np.divmod(pixels[rows], shape[1])
    padded = np.pad(image, radius, constant_values=-np.inf)
    own = image[row, column]
    for y, x in np.ndindex(window.shape):
        down, across = y - radius, x - radius
        tied = np.flatnonzero(padded[row + y, column + x] == own)
        if not len(tied) or (down, across) == (0, 0):
            continue
        here = np.column_stack([column[tied], row[tied] + first_row])
        first, second = (
            bayer_order(xy, (shape[1], height)) for xy in (here, here + (across, down))
        )
        before = second <= first if (down, across) < (0, 0) else second < first
        kept[rows[tied[before]]] = False
    return kept


def peak_offset(ranking: np.ndarray, row: np.ndarray, column: np.ndarray, axis: int) -> np.ndarray:
    """Return the offset of the maximum of a parabola through pixels and their neighbours.

    It is 0 on the image's border, and where a pixel is not a maximum along the axis.
    """
    position, last = (row, column)[axis], ranking.shape[axis] - 1
    inner = (position > 0) & (position < last)
    before, after = (
        ranking[
            np.clip(row + step * (axis == 0), 0, ranking.shape[0] - 1),
            np.clip(column + step * (axis == 1), 0, ranking.shape[1] - 1),
        ].astype(np.float64)
        for step in (-1, 1)
    )
    middle = ranking[row, column].astype(np.float64)
    bend = 2 * middle - before - after
    peaked = inner & (middle >= before) & (middle >= after) & (bend > 0)
    offset = np.where(peaked, (after - before) / np.where(peaked, 2 * bend, 1), 0)
    return np.clip(offset, -MAX_OFFSET_PX, MAX_OFFSET_PX).astype(np.float32)
