"""Selection of keypoints: from heat maps, and from sets of positions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.options import suggest_keywords
from .keypoints import Keypoints, bayer_order

MODES = ("auto", "dense", "points")
SPREADS = ("none", "grid", "anms")

MAX_OFFSET_PX = 0.499
"""The nearest pixel of a refined keypoint is still the one that it was found at."""


def check_max_keypoints(count: int | None) -> None:
    """Raise an OptionError where a largest number of keypoints is no whole number above 0."""
    if count is not None and not (count >= 1 and count % 1 == 0):
        raise OptionError(f"`max_keypoints` must be a whole number from 1 on, not {count}")


@dataclass(frozen=True, eq=False)
class SelectionOptions:
    """Which pixels of a heat map become keypoints.

    Attributes:
        threshold: pixels with a probability above it become keypoints (paper: tau = 0.5).
        density: keypoints per pixel, in (0, 1]; replaces the threshold: this fraction of the pixels
            is taken, the most probable ones.
        max_keypoints: at most this many are kept, the most probable ones.
        nms_radius: of non-maximum suppression in pixels: a pixel is kept when it ranks highest
            within this distance in x and y (0: no suppression). None: 1 (a window of 3x3) with
            `max_keypoints`, else 0.
        subpixel: refine positions to the maximum of a parabola through the pixel and its two
            neighbours, in x and in y. None: with `max_keypoints` only.
        ignore: (H, W) bool or number array, true where keypoints are ignored.
        mode: "dense" takes pixels of the heat map; "points" takes the best keypoints of all
            scales, which are more repeatable where few are wanted, and need no heat map. "auto"
            means points with `max_keypoints` and no other option of dense keypoints (threshold,
            density, suppression, `subpixel`), else dense.
        spread: of points: "none" takes the best; "grid" in turn the best of each cell of a grid;
            "anms" the best that are as far from each other as their number allows.

    Raises:
        OptionError: a value is unknown or out of its range, or options do not fit together.
    """

    threshold: float = 0.5
    density: float | None = None
    max_keypoints: int | None = None
    nms_radius: int | None = None
    subpixel: bool | None = None
    ignore: np.ndarray | None = field(default=None, repr=False)
    mode: Literal["auto", "dense", "points"] = "auto"
    spread: Literal["none", "grid", "anms"] = "none"

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise OptionError(f"the threshold must lie in [0, 1], not {self.threshold}")
        if self.density is not None and not 0 < self.density <= 1:
            raise OptionError(f"the density must lie in (0, 1], not {self.density}")
        check_max_keypoints(self.max_keypoints)
        if self.nms_radius is not None:
            if self.nms_radius < 0:
                raise OptionError(f"`nms_radius` must be 0 or more pixels, not {self.nms_radius}")
            if self.nms_radius != int(self.nms_radius):
                raise OptionError(
                    f"`nms_radius` must be a whole number of pixels, not {self.nms_radius}"
                )

        if self.mode not in MODES:
            raise unknown_name("mode", self.mode, MODES)
        if self.spread not in SPREADS:
            raise unknown_name("spread", self.spread, SPREADS)
        if self.mode == "points" and self._has_dense_options:
            raise OptionError(
                "threshold, density, `nms_radius` and `subpixel` belong to dense keypoints: leave "
                "them out, or use mode='dense'"
            )
        if self.spread != "none" and not (self.uses_points and self.max_keypoints is not None):
            raise OptionError(
                f"`spread={self.spread!r}` needs `max_keypoints` and no option of dense keypoints"
            )

    @property
    def uses_points(self) -> bool:
        """Whether keypoints of all scales are wanted instead of pixels of the heat map."""
        if self.mode != "auto":
            return self.mode == "points"
        return self.max_keypoints is not None and not self._has_dense_options

    @property
    def _has_dense_options(self) -> bool:
        """Whether an option of dense keypoints differs from its default."""
        return (
            self.density is not None
            or self.nms_radius is not None
            or self.subpixel is not None
            or self.threshold != SelectionOptions.threshold
        )

    @property
    def suppression_radius(self) -> int:
        """The effective radius of non-maximum suppression in pixels."""
        if self.nms_radius is None:
            return 0 if self.max_keypoints is None else 1
        return int(self.nms_radius)

    @property
    def refines(self) -> bool:
        """Whether positions are refined."""
        return self.max_keypoints is not None if self.subpixel is None else self.subpixel


@suggest_keywords
def select_keypoints(
    heatmap: np.ndarray,
    options: SelectionOptions = SelectionOptions(),
    logits: np.ndarray | None = None,
) -> Keypoints:
    """Select the keypoints of a heat map.

    Args:
        heatmap: (H, W) float32 probability.
        options: which ones. The order of the steps is: ignore mask, threshold, suppression,
            density or maximum number, sub-pixel refinement.
        logits: (H, W) float32 logits of the map, by which keypoints are ranked; by default the
            map itself, although float32 rounds its highest probabilities to 1. Ties are broken
            by an order that spreads the keypoints evenly (`bayer_order`).

    Returns:
        Keypoints in row-major order, on pixel centres unless `subpixel`.

    Raises:
        OptionError: the ignore mask or the logits differ from the map in size.

    Example:
        >>> heatmap = np.zeros((16, 16), np.float32)
        >>> heatmap[4, 9] = 0.9
        >>> select_keypoints(heatmap).xy.tolist()
        [[9.0, 4.0]]
    """
    height, width = heatmap.shape
    ranking = heatmap if logits is None else logits
    if ranking.shape != heatmap.shape:
        raise OptionError(
            f"the logits have shape {ranking.shape}, the heat map {heatmap.shape}: "
            "they must be equal"
        )
    # With a density, all pixels but the impossible ones may be needed.
    wanted = heatmap > (options.threshold if options.density is None else 0.0)
    if options.ignore is not None:
        wanted &= ~check_ignore(options.ignore, heatmap.shape)
    pixels = np.flatnonzero(wanted)
    ranks = ranking.ravel()
    if options.suppression_radius and len(pixels):
        pixels = pixels[_suppress(pixels, ranks[pixels], heatmap.shape, options.suppression_radius)]
    count = _wanted_count(options, heatmap.size)
    if count is not None and len(pixels) > count:
        scores = ranks[pixels]
        # Only the best are sorted, and those that tie with the last of them.
        pixels = pixels[scores >= np.partition(scores, len(scores) - count)[len(scores) - count]]
        pixels = pixels[np.sort(_ranked(pixels, ranks[pixels], heatmap.shape)[:count])]
    row, column = np.divmod(pixels, width)
    xy = np.stack([column, row], 1).astype(np.float32)
    if options.refines:
        xy += np.stack([_peak_offset(ranking, row, column, axis) for axis in (1, 0)], 1)
    found = None if logits is None else ranks[pixels]
    return Keypoints(xy, heatmap.ravel()[pixels], (width, height), found)


def check_ignore(ignore: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an ignore mask as (H, W) bool.

    Raises:
        OptionError: it differs from the image in size.
    """
    mask = np.asarray(ignore)
    if mask.shape != shape:
        raise OptionError(
            f"the ignore mask has shape {mask.shape}, the image (height, width) {shape}: they "
            "must be equal"
        )
    return mask.astype(bool)


def _peak_offset(ranking: np.ndarray, row: np.ndarray, column: np.ndarray, axis: int) -> np.ndarray:
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


def _ranked(pixels: np.ndarray, scores: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the rows from best to worst; ties are spread evenly over the image."""
    row, column = np.divmod(pixels, shape[1])
    spread = bayer_order(np.column_stack([column, row]), (shape[1], shape[0]))
    return np.lexsort((spread, -scores))


def _wanted_count(options: SelectionOptions, pixels: int) -> int | None:
    counts = []
    if options.density is not None:
        counts.append(round(options.density * pixels))
    if options.max_keypoints is not None:
        counts.append(options.max_keypoints)
    return min(counts) if counts else None


def _suppress(
    pixels: np.ndarray, scores: np.ndarray, shape: tuple[int, ...], radius: int
) -> np.ndarray:
    """Return which pixels rank highest in the window around them.

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
        here = np.column_stack([column[tied], row[tied]])
        first, second = (
            bayer_order(xy, (shape[1], shape[0])) for xy in (here, here + (across, down))
        )
        before = second <= first if (down, across) < (0, 0) else second < first
        kept[rows[tied[before]]] = False
    return kept


def grid_subsample(xy: np.ndarray, grid_size_px: int, seed: int = 0) -> np.ndarray:
    """Choose one random position of each cell of a grid; (K,) rows in rising order.

    Args:
        xy: (N, 2) positions.
        grid_size_px: side of the square cells in pixels.
        seed: of the choice.

    Example:
        >>> len(grid_subsample(np.array([[0, 0], [5, 5], [40, 5]]), 16))
        2
    """
    cell = np.floor(np.asarray(xy, np.float64) / grid_size_px).astype(np.int64)
    order = np.random.default_rng(seed).permutation(len(cell))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(order[first])
