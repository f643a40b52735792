"""Two photographs in a frame in which matches lie on the same row, and the disparities there.

Rows are matched (`matching.stereo`) in the range that sparse matches, and small copies, allow. What
the windows of the two views show tells which disparities are kept: how well they correlate by
chance is measured on rows that show something else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.epipolar_rectification import PolarFrame, RectifiedFrame, rectified_frame
from ...geometry.rescaling import downscale, scaled_fundamental, scaled_points
from ...geometry.zncc import gaussian_blur, local_zncc
from ..stereo.matching import (
    DisparityMap,
    DisparityOptions,
    compute_disparity,
    find_disparity_range,
)
from .options import RectifiedMatchingOptions

Range = tuple[int, int]


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """Two images in their frame, and the disparities between them.

    Attributes:
        frame: the frame, of the images at `scale`.
        scale: of both images, at most 1.
        first, second: (H, W) uint8, the warped images.
        disparities: of every pixel of the first, those that geometry may rely on.
        kept: (H, W) float32 disparities of the matches that are kept, perhaps more; else NaN.
        correlation: (H, W) float32 local ZNCC of both after the disparity, where one is kept.
    """

    frame: RectifiedFrame
    scale: float
    first: np.ndarray
    second: np.ndarray
    disparities: DisparityMap
    kept: np.ndarray
    correlation: np.ndarray


def rectified_view(
    gray0: np.ndarray,
    gray1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    fundamental: np.ndarray,
    options: RectifiedMatchingOptions,
) -> RectifiedView | None:
    """Rectify both images, smaller where there would be too much to search, and match rows."""
    scale, sizes = 1.0, (gray0.shape[::-1], gray1.shape[::-1])
    frame = rectified_frame(points0, points1, fundamental, *sizes, options.frame)
    if frame is None:
        return None
    low, high = _range_of_matches(frame, points0, points1, options)
    volume = float(np.prod(frame.size)) * (high - low + 1)
    if volume > options.max_volume:
        longest = max(*gray0.shape, *gray1.shape)
        side = max(1, round(longest * (options.max_volume / volume) ** (1 / 3)))
        scale = side / longest
        gray0, gray1 = (
            downscale(gray, round(max(gray.shape) * scale))[0] for gray in (gray0, gray1)
        )
        points0, points1 = scaled_points(points0, scale), scaled_points(points1, scale)
        fundamental = scaled_fundamental(fundamental, scale, scale)
        sizes = (gray0.shape[::-1], gray1.shape[::-1])
        frame = rectified_frame(points0, points1, fundamental, *sizes, options.frame)
        if frame is None:
            return None
    (first, valid0), (second, valid1) = frame.warp(gray0, 0), frame.warp(gray1, 1)
    low, high = _range_of_matches(frame, points0, points1, options)
    # About an epipole everything grows, or everything shrinks: what small copies of the two views
    # agree on in the other direction is wrong.
    polar = isinstance(frame, PolarFrame)
    seen = None if polar else find_disparity_range(first, second)
    if seen is not None:
        low, high = min(low, seen[0]), max(high, seen[1])
        # What both views agree on may be far off where much of a frame shows nothing.
        limit = int(options.max_volume / float(np.prod(frame.size)))
        if high - low > limit:
            low, high = _range_of_matches(frame, points0, points1, options)
    widest = frame.size[0] - 1
    low, high = max(low, -widest), min(high, widest)
    if low >= high:
        return None
    chosen = replace(options.disparity, disparity_range=(low, high))
    found, correlation = _match_rows(first, second, valid0, valid1, chosen, options)
    chance = _match_by_chance(first, second, valid0, valid1, chosen, options)
    bounds = _correlation_bounds(
        correlation[found.matched], *chance, int(np.count_nonzero(valid0)), options
    )
    relied, kept = (found.matched & (correlation >= bound) for bound in bounds)
    nan = np.float32(np.nan)
    return RectifiedView(
        frame,
        scale,
        first,
        second,
        DisparityMap(np.where(relied, found.disparity, nan), relied, found.disparity_range),
        np.where(kept, found.disparity, nan),
        np.where(kept, correlation, nan),
    )


def _match_rows(
    first: np.ndarray,
    second: np.ndarray,
    valid0: np.ndarray,
    valid1: np.ndarray,
    disparity_options: DisparityOptions,
    options: RectifiedMatchingOptions,
) -> tuple[DisparityMap, np.ndarray]:
    """Return the disparities where both views show something, and the correlation after them."""
    found = compute_disparity(first, second, disparity_options)
    row, column = np.indices(first.shape, dtype=np.float32)
    known = found.matched & np.isfinite(found.disparity)
    there = np.where(known, column - found.disparity, -1).astype(np.float32)
    aligned = cv2.remap(second, there, row, cv2.INTER_LINEAR)
    shown = cv2.remap(valid1.astype(np.uint8), there, row, cv2.INTER_NEAREST) > 0
    known &= valid0 & shown
    correlation = local_zncc(
        gaussian_blur(first, options.correlation_sigma_px),
        gaussian_blur(aligned, options.correlation_sigma_px),
        np.ones(first.shape, bool),
        options.correlation_window_px,
    )
    matched = DisparityMap(found.disparity, known, found.disparity_range)
    return matched, np.where(known, np.nan_to_num(correlation), np.float32(-1))


def _match_by_chance(
    first: np.ndarray,
    second: np.ndarray,
    valid0: np.ndarray,
    valid1: np.ndarray,
    disparity_options: DisparityOptions,
    options: RectifiedMatchingOptions,
) -> tuple[np.ndarray, int]:
    """Return the correlations of matches by chance, and for how many pixels they were sought.

    Some rows are matched with rows of the second view that show something else: what is found there
    is found by chance, the best of as many disparities as everywhere.
    """
    height = len(first)
    count = max(1, round(height * options.null_fraction))
    start = (height - count) // 2
    rows = np.arange(start, start + count)
    others = (rows + height // 2) % height
    valid = valid0[rows], valid1[others]
    found, correlation = _match_rows(
        first[rows], second[others], *valid, disparity_options, options
    )
    return correlation[found.matched], int(np.count_nonzero(valid[0]))


def _correlation_bounds(
    correlations: np.ndarray,
    by_chance: np.ndarray,
    chance_pixels: int,
    pixels: int,
    options: RectifiedMatchingOptions,
) -> tuple[float, float]:
    """Return the least correlation of a match that geometry relies on, and of one that is kept.

    Args:
        correlations: of the matches.
        by_chance: of matches by chance.
        chance_pixels, pixels: for how many pixels these and the matches were sought.
        options: how many may be found by chance.
    """
    null = np.sort(by_chance)[::-1]
    allowed = int(options.false_positive_rate * chance_pixels)
    high = max(options.min_correlation, float(null[allowed]) if len(null) > allowed else -1.0)
    # Where nearly nothing is found by chance and nearly all else is, low correlation is no reason
    # to doubt: smooth surfaces are matched by what surrounds them.
    ordered = np.sort(correlations)
    bounds = np.append(-1.0, null[::-1])
    matches = len(ordered) - np.searchsorted(ordered, bounds)
    wrong = (len(null) - np.searchsorted(null[::-1], bounds)) * pixels / max(chance_pixels, 1)
    few = bounds[(wrong <= options.false_discovery_rate * matches) & (chance_pixels > 0)]
    return high, min(high, float(few.min())) if len(few) else high


def _range_of_matches(
    frame: RectifiedFrame,
    points0: np.ndarray,
    points1: np.ndarray,
    options: RectifiedMatchingOptions,
) -> Range:
    """Return the disparities of sparse matches, with a margin on both sides."""
    disparity = frame.to_frame(points0, 0)[:, 0] - frame.to_frame(points1, 1)[:, 0]
    disparity = disparity[np.isfinite(disparity)]
    if not len(disparity):
        return 0, 0
    smallest, largest = range_with_margin(disparity, options)
    if isinstance(frame, PolarFrame):
        if np.mean(disparity > 0) > options.min_fraction_of_one_sign:
            smallest = max(smallest, -options.margin_px)
        if np.mean(disparity < 0) > options.min_fraction_of_one_sign:
            largest = min(largest, options.margin_px)
    return int(np.floor(smallest)), int(np.ceil(largest))


def range_with_margin(
    disparity: np.ndarray, options: RectifiedMatchingOptions
) -> tuple[float, float]:
    """Return the range of most disparities, with a margin on both sides."""
    tail = options.tail_fraction
    low, high = np.quantile(disparity, [tail, 1 - tail])
    margin = options.margin_px + options.margin_fraction * (high - low)
    return float(low - margin), float(high + margin)
