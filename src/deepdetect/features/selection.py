"""Selection of keypoints from heat maps, and of well-spread subsets of any keypoints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.options import numbers_of, suggest_keywords
from ..geometry.frames import uniform_frame
from .keypoints import Keypoints, bayer_order

MAX_OFFSET_PX = 0.499
"""Maximum sub-pixel shift in x and in y: below 0.5, so that the nearest pixel stays the same."""

Rows = Callable[[slice], np.ndarray]
"""A function that returns the rows of an (H, W) map that a slice selects."""

BAND_PIXELS = 4_000_000
"""Maps are processed in bands of about this many pixels, to limit memory. Chosen by hand."""

GRID_CELLS = 24
"""Number of cells of `spread_over_grid` along the longer side of the image. Chosen by hand."""

DISTANCE_STEP_PX = 0.25
"""Precision, in pixels, to which `spread_by_distance` searches its distance. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class Maps:
    """A heat map and the logits that rank its pixels, each computed on demand.

    Both maps are (H, W) float32. `heatmap()` computes the heat map, and returns a function that
    gives its rows. `logits()` computes and returns the logits. A map of a large image takes more
    memory than the keypoints, so only one map is held at a time.
    """

    shape: tuple[int, ...]
    heatmap: Callable[[], Rows]
    logits: Callable[[], np.ndarray]

    @classmethod
    def of_logits(cls, logits: np.ndarray) -> Maps:
        """Return maps with these logits; rows of the heat map are computed from them on demand."""
        return cls(logits.shape, lambda: lambda rows: sigmoid(logits[rows]), lambda: logits)

    def both(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the whole heat map and the logits, (H, W) float32 each."""
        heatmap, rows_of = np.empty(self.shape, np.float32), self.heatmap()
        for rows in bands(self.shape):
            heatmap[rows] = rows_of(rows)
        del rows_of  # frees the map that the function may hold
        return heatmap, self.logits()


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return the probabilities of logits, without overflow for any logit."""
    decay = np.exp(-np.abs(logits))
    return np.where(logits >= 0, np.float32(1), decay) / (1 + decay)


def bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield slices of rows that divide a map into bands of about `BAND_PIXELS` pixels."""
    rows = max(1, BAND_PIXELS // max(1, shape[1]))
    for start in range(0, shape[0], rows):
        yield slice(start, min(start + rows, shape[0]))


def check_max_keypoints(count: int | None) -> None:
    """Raise an OptionError if a maximum number of keypoints is not a whole number above 0."""
    if count is not None and not (count >= 1 and count % 1 == 0):
        raise OptionError(f"`max_keypoints` must be a whole number from 1 on, not {count}")


@suggest_keywords
@dataclass(frozen=True)
class SelectionOptions:
    """Which pixels of a heat map become keypoints.

    Attributes:
        threshold: pixels with a probability above this become keypoints (DeepDetect paper: 0.5).
        density: keypoints per pixel, in (0, 1]. If set, the threshold is not used: the most
            probable pixels are taken, up to this fraction of all pixels.
        max_keypoints: maximum number of keypoints; the most probable ones are kept.
        nms_radius: radius of non-maximum suppression in pixels: a pixel is kept if it ranks highest
            within this distance in x and y; 0 keeps all.
        subpixel: refine x and y to the maxima of parabolas through three pixels along each axis.

    Raises:
        OptionError: a value is out of its range.
    """

    threshold: float = 0.5
    density: float | None = None
    max_keypoints: int | None = None
    nms_radius: int = 0
    subpixel: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise OptionError(f"the threshold must lie in [0, 1], not {self.threshold}")
        if self.density is not None and not 0 < self.density <= 1:
            raise OptionError(f"the density must lie in (0, 1], not {self.density}")
        check_max_keypoints(self.max_keypoints)
        if not (self.nms_radius >= 0 and self.nms_radius % 1 == 0):
            raise OptionError(f"`nms_radius` must be whole and 0 or more, not {self.nms_radius}")


@suggest_keywords
def select_keypoints(
    heatmap: np.ndarray,
    options: SelectionOptions = SelectionOptions(),
    logits: np.ndarray | None = None,
    *,
    ignore: np.ndarray | None = None,
) -> Keypoints:
    """Select the dense keypoints of a heat map.

    With the heat map and the logits of `DeepDetect.heatmap_and_logits`, the result is the same as
    that of `detect` with the same options.

    Args:
        heatmap: (H, W) float32 probabilities.
        options: which pixels are selected. The order of the steps is: ignore mask, threshold,
            suppression, density or maximum number, sub-pixel refinement.
        logits: (H, W) float32 logits of the heat map, by which pixels are ranked. None: pixels are
            ranked by the heat map, whose highest probabilities float32 rounds to 1. Ties are broken
            by an order that spreads the keypoints evenly (`bayer_order`).
        ignore: (H, W) array of bool or numbers, true or not 0 where keypoints are ignored.

    Returns:
        Keypoints in row-major order, on pixel centres unless `subpixel` is set.

    Raises:
        OptionError: the ignore mask or the logits differ from the map in size.

    Example:
        >>> heatmap = np.zeros((16, 16), np.float32)
        >>> heatmap[4, 9] = 0.9
        >>> select_keypoints(heatmap).xy.tolist()
        [[9.0, 4.0]]
        >>> len(select_keypoints(heatmap, SelectionOptions(threshold=0.95)))
        0
    """
    if heatmap.dtype.kind != "f":
        heatmap = heatmap.astype(np.float32)
    ranking = heatmap if logits is None else logits
    if ranking.shape != heatmap.shape:
        raise OptionError(
            f"the logits must have the shape {heatmap.shape} of the map, not {ranking.shape}"
        )
    maps = Maps(ranking.shape, lambda: heatmap.__getitem__, lambda: ranking)
    keypoints = select_from_maps(maps, options, ignore)
    return keypoints if logits is not None else replace(keypoints, logits=None)


def select_from_maps(
    maps: Maps, options: SelectionOptions, ignore: np.ndarray | None = None
) -> Keypoints:
    """Select keypoints as `select_keypoints` does, from maps that are computed on demand."""
    height, width = maps.shape
    passing = _passing(maps, options, ignore)
    ranking = maps.logits()
    chosen = _choose(passing, ranking, options)
    del passing
    counts = [int(np.bitwise_count(chosen[rows]).sum()) for rows in bands(maps.shape)]
    xy = np.zeros((sum(counts), 2), np.float32)
    scores, logits = np.empty(len(xy), np.float32), np.empty(len(xy), np.float32)
    parts = [
        (rows, slice(end - count, end))
        for rows, end, count in zip(bands(maps.shape), np.cumsum(counts), counts, strict=True)
    ]
    # To save memory, the logits are freed before the heat map is computed.
    for rows, part in parts:
        pixels = _unpack(chosen[rows], width)
        logits[part] = ranking[rows].ravel()[pixels]
        if options.subpixel:
            row, column = np.divmod(pixels, width)
            for k, axis in ((0, 1), (1, 0)):
                xy[part, k] = peak_offset(ranking, row + rows.start, column, axis)
    del ranking
    heatmap = maps.heatmap()
    for rows, part in parts:
        scores[part] = heatmap(rows).ravel()[_unpack(chosen[rows], width)]
    del heatmap
    for rows, part in parts:
        row, column = np.divmod(_unpack(chosen[rows], width), width)
        xy[part, 0] += column.astype(np.float32)
        xy[part, 1] += (row + rows.start).astype(np.float32)
    return Keypoints(xy, scores, (width, height), logits)


def _unpack(packed: np.ndarray, width: int) -> np.ndarray:
    """Return the flat indices of the pixels that are set in a bit mask, packed along the rows."""
    return np.flatnonzero(np.unpackbits(packed, axis=1, count=width))


def _passing(maps: Maps, options: SelectionOptions, ignore: np.ndarray | None) -> np.ndarray:
    """Return a bit mask, packed along the rows, of pixels above the threshold and not ignored."""
    if ignore is not None:
        ignore = check_ignore(ignore, maps.shape)
    # With a density, all pixels with a probability above 0 may become keypoints.
    threshold = options.threshold if options.density is None else 0.0
    packed, heatmap = [], maps.heatmap()
    for rows in bands(maps.shape):
        passing = heatmap(rows) > threshold
        if ignore is not None:
            passing &= ~ignore[rows]
        packed.append(np.packbits(passing, axis=1))
    return np.concatenate(packed)


def _choose(passing: np.ndarray, ranking: np.ndarray, options: SelectionOptions) -> np.ndarray:
    """Return the pixels that become keypoints, as a bit mask packed along the rows."""
    height, width = ranking.shape
    radius = int(options.nms_radius)
    shares = [] if options.density is None else [round(options.density * ranking.size)]
    limits = [] if options.max_keypoints is None else [int(options.max_keypoints)]
    count = min(shares + limits, default=None)
    if not radius and count is None:
        return passing
    ranks = ranking.ravel()

    def wanted(rows: slice) -> np.ndarray:
        """Return the flat indices of a band's pixels that pass and are not suppressed."""
        # Suppression also depends on the pixels within `radius` outside the band.
        seen = slice(max(0, rows.start - radius), min(height, rows.stop + radius))
        pixels = _unpack(passing[seen], width)
        if radius and len(pixels):
            near = ranking[seen]
            scores = near.ravel()[pixels]
            pixels = pixels[_is_highest(pixels, scores, near.shape, radius, seen.start, height)]
        pixels += seen.start * width
        return pixels[(pixels >= rows.start * width) & (pixels < rows.stop * width)]

    in_bands = list(bands(ranking.shape))
    only = wanted(in_bands[0]) if len(in_bands) == 1 else None  # computed once for both loops
    lowest = np.float32(-np.inf)
    if count is not None:
        parts = (ranks[wanted(rows) if only is None else only] for rows in in_bands)
        lowest = _least_of_the_best(parts, count, ranking.dtype)
    chosen, kept, tied = np.zeros_like(passing), 0, []
    for rows in in_bands:
        pixels = wanted(rows) if only is None else only
        if count is not None:
            pixels = pixels[ranks[pixels] >= lowest]
            tied.append(pixels[ranks[pixels] == lowest])
        kept += len(pixels)
        mask = np.zeros(ranking[rows].shape, bool)
        mask.ravel()[pixels - rows.start * width] = True
        chosen[rows] = np.packbits(mask, axis=1)
    if count is not None and kept > count:
        last = np.concatenate(tied)
        row, column = np.divmod(last, width)
        spread = bayer_order(np.column_stack([column, row]), (width, height))
        dropped = last[np.argsort(spread, kind="stable")[len(last) - (kept - count) :]]
        row, column = np.divmod(dropped, width)
        np.bitwise_and.at(chosen, (row, column // 8), ~(128 >> column % 8).astype(np.uint8))
    return chosen


def _least_of_the_best(parts: Iterable[np.ndarray], count: int, kind: np.dtype) -> np.floating:
    """Return the `count`-th highest value in all arrays; -infinity if they hold fewer."""
    if count == 0:  # the density asks for less than half a keypoint
        return kind.type(np.inf)
    best = np.empty(0, kind)
    for part in parts:
        best = np.concatenate([best, part])
        if len(best) > count:
            best = np.partition(best, len(best) - count)[len(best) - count :]
    return best.min() if len(best) >= count else kind.type(-np.inf)


def _is_highest(
    pixels: np.ndarray,
    scores: np.ndarray,
    shape: tuple[int, ...],
    radius: int,
    first_row: int,
    height: int,
) -> np.ndarray:
    """Return, for each pixel, whether it ranks highest in the square window around it.

    `pixels` are flat indices in a band of this shape, which starts at row `first_row` of the image.
    Among equal scores, the first pixel in `bayer_order` ranks highest.
    """
    kind = np.float32 if scores.dtype == np.float32 else np.float64
    image = np.full(shape, -np.inf, kind)
    image.ravel()[pixels] = np.maximum(scores, np.finfo(kind).min)
    radius = min(radius, max(shape))
    window = np.ones((2 * radius + 1,) * 2, np.uint8)  # OpenCV dilates fast by a square
    highest = cv2.dilate(image, window) == image  # outside the border the value is -infinity
    kept = highest.ravel()[pixels]
    rows = np.flatnonzero(kept)
    row, column = np.divmod(pixels[rows], shape[1])
    padded = np.pad(image, radius, constant_values=-np.inf)
    middle = image[row, column]
    for y, x in np.ndindex(window.shape):
        down, across = y - radius, x - radius
        tied = np.flatnonzero(padded[row + y, column + x] == middle)
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
    """Fit a parabola through each pixel and its two neighbours; return the offset of its maximum.

    The neighbours are those in y if the axis is 0, and in x if it is 1. The offset is 0 at the
    border of the image, and if a neighbour is higher than the pixel.
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
    return np.clip(offset, -MAX_OFFSET_PX, MAX_OFFSET_PX)


def check_ignore(ignore: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an ignore mask as (H, W) bool; a size other than the image's raises an OptionError."""
    mask = numbers_of("ignore", ignore, bool)
    if mask.shape != shape:
        raise OptionError(
            f"the ignore mask must have the shape {shape} of the image, not {mask.shape}"
        )
    return mask


def without_frame(rgb: np.ndarray, ignore: np.ndarray | None) -> np.ndarray | None:
    """Add the uniform frame of a (H, W, 3) image, if it has one, to the image's ignore mask."""
    frame = uniform_frame(rgb)
    return ignore if not frame.any() else frame if ignore is None else frame | ignore


def grid_subsample(xy: np.ndarray, grid_size_px: int, seed: int = 0) -> np.ndarray:
    """Choose a random position in each grid cell; return their rows of `xy`, ascending."""
    cell = np.floor(np.asarray(xy, np.float64) / grid_size_px).astype(np.int64)
    order = np.random.default_rng(seed).permutation(len(cell))
    column, row = (cell - cell.min(axis=0, initial=0)).T
    _, first = np.unique((row * (column.max(initial=0) + 1) + column)[order], return_index=True)
    return np.sort(order[first])


def spread_over_grid(
    xy: np.ndarray,
    scores: np.ndarray,
    image_size: tuple[int, int],
    max_keypoints: int,
    grid_cells: int = GRID_CELLS,
) -> np.ndarray:
    """Choose the best keypoint of each cell of a grid, then the second-best of each, and so on.

    Returns at most `max_keypoints` rows of `xy`. `grid_cells` cells cover the image's longer side.
    """
    side = max(image_size) / grid_cells
    cell = np.floor(np.maximum(xy, 0) / side).astype(np.int64)
    cell = cell[:, 1] * (grid_cells + 1) + cell[:, 0]
    order = np.lexsort((-scores, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    begins = np.repeat(first, np.diff(first, append=len(order)))
    rank = np.arange(len(order)) - begins
    return order[np.lexsort((-scores[order], rank))][:max_keypoints]


def descending_order(values: np.ndarray) -> np.ndarray:
    """Return the indices that sort (N,) numbers from the highest to the lowest.

    Among equal numbers, the lower index comes first. For float32 this is faster than NumPy.
    """
    if values.dtype != np.float32:
        return np.argsort(-values, kind="stable")
    # The bits of floats, read as integers, have the same order as the floats' magnitudes.
    bits = (values + np.float32(0)).view(np.int32)
    keys = np.where(bits < 0, bits & 0x7FFFFFFF, ~bits).astype(np.int64) << 32
    keys |= np.arange(len(values))
    keys.sort()
    return keys & 0xFFFFFFFF


def suppress_neighbors(
    xy: np.ndarray, scores: np.ndarray, radius_px: float | np.ndarray, max_count: int | None = None
) -> np.ndarray:
    """Keep the points, best first, that are not near a better kept point; return the kept rows.

    The rows are ordered best first; among equal scores, the lower row counts as better. Two points
    are near if their distance is below the radius or, with (N,) radii, below the smaller of their
    two radii. At most `max_count` points are kept.
    """
    from .kernels import keep_distant

    order = descending_order(np.asarray(scores))
    if not len(order):
        return order
    positions = np.asarray(xy, np.float64).reshape(-1, 2)[order]
    x, y = np.ascontiguousarray((positions - positions.min(0)).T)
    radii = np.broadcast_to(np.asarray(radius_px, np.float64), len(order))[order]
    cell = float(radii.min())
    columns, rows = int(x.max() / cell) + 1, int(y.max() / cell) + 1
    kept = np.empty(len(order) if max_count is None else min(max_count, len(order)), np.int64)
    chains = np.full(rows * columns, -1), np.full(len(order), -1)
    return order[kept[: keep_distant(cell, columns, x, y, radii, *chains, kept)]]


def spread_by_distance(xy: np.ndarray, scores: np.ndarray, count: int) -> np.ndarray:
    """Choose `count` good points that lie as far apart as possible; return their rows, best first.

    A search finds the largest distance at which suppression still keeps `count` points.
    """
    best = descending_order(np.asarray(scores))
    if count >= len(best):
        return best
    near, far = 0.0, float(np.linalg.norm(np.ptp(np.asarray(xy, np.float64), axis=0))) + 1
    while far - near > DISTANCE_STEP_PX:
        middle = (near + far) / 2
        kept = suppress_neighbors(xy, scores, middle, count)
        if len(kept) >= count:
            near, best = middle, kept
        else:
            far = middle
    return best[:count]
