"""Two images in a frame in which matches lie on the same row, and the disparities there.

Rows are matched (`matching.stereo`) in the range that sparse matches, and small copies, allow. What
the windows of the two views show tells which disparities are kept: how well they correlate by
chance is measured on rows that show something else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.epipolar_rectification import PolarFrame, RectifiedFrame, rectified_frame
from ...geometry.images import downscale, gaussian_blur, local_zncc
from ...geometry.transforms import scaled_fundamental, scaled_points
from ..stereo.matching import (
    DisparityMap,
    DisparityOptions,
    compute_disparity,
    find_disparity_range,
)

Range = tuple[int, int]

DISPARITY = DisparityOptions(discontinuity_margin_px=1)
"""How rows are matched; the range is found."""

MAX_VOLUME = 1e8
"""Pixels of the frame times disparities; with more, the images are scaled down."""

TAIL_FRACTION = 0.01
"""Of the disparities of sparse matches at each end, which may be wrong."""

MARGIN_PX, MARGIN_FRACTION = 4.0, 0.25
"""Added to the range of disparities at both ends, in pixels, and as a fraction of it."""

MIN_FRACTION_OF_ONE_SIGN = 0.8
"""Where so many sparse matches grow about an epipole, or shrink, others do so by `MARGIN_PX` at
most."""

CORRELATION_WINDOW_PX = 9
"""Side of the window in which both images are compared after matching."""

CORRELATION_SIGMA_PX = 1.0
"""Of the blur before that."""

MIN_CORRELATION = 0.3
"""A match whose windows correlate less is left out, unless `FALSE_DISCOVERY_RATE` allows it."""

FALSE_POSITIVE_RATE = 0.01
"""So many of the pixels may be matched by chance; matches whose windows correlate too little for
that are left out. It is measured on rows that show something else."""

FALSE_DISCOVERY_RATE = 0.01
"""While no more than this fraction of the matches is found by chance, the two bounds above hold
only for the matches that geometry relies on."""

NULL_FRACTION = 0.25
"""Of the rows, which are matched with others for that."""


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
) -> RectifiedView | None:
    """Rectify both images, smaller where there would be too much to search, and match rows."""
    scale, sizes = 1.0, (gray0.shape[::-1], gray1.shape[::-1])
    frame = rectified_frame(points0, points1, fundamental, *sizes)
    if frame is None:
        return None
    low, high = _range_of_matches(frame, points0, points1)
    volume = float(np.prod(frame.size)) * (high - low + 1)
    if volume > MAX_VOLUME:
        longest = max(*gray0.shape, *gray1.shape)
        side = max(1, round(longest * (MAX_VOLUME / volume) ** (1 / 3)))
        scale = side / longest
        gray0, gray1 = (
            downscale(gray, round(max(gray.shape) * scale))[0] for gray in (gray0, gray1)
        )
        points0, points1 = scaled_points(points0, scale), scaled_points(points1, scale)
        fundamental = scaled_fundamental(fundamental, scale, scale)
        sizes = (gray0.shape[::-1], gray1.shape[::-1])
        frame = rectified_frame(points0, points1, fundamental, *sizes)
        if frame is None:
            return None
    (first, valid0), (second, valid1) = frame.warp(gray0, 0), frame.warp(gray1, 1)
    low, high = _range_of_matches(frame, points0, points1)
    # About an epipole everything grows, or everything shrinks: what small copies of the two views
    # agree on in the other direction is wrong.
    polar = isinstance(frame, PolarFrame)
    seen = None if polar else find_disparity_range(first, second)
    if seen is not None:
        low, high = min(low, seen[0]), max(high, seen[1])
        # What both views agree on may be far off where much of a frame shows nothing.
        limit = int(MAX_VOLUME / float(np.prod(frame.size)))
        if high - low > limit:
            low, high = _range_of_matches(frame, points0, points1)
    widest = frame.size[0] - 1
    low, high = max(low, -widest), min(high, widest)
    if low >= high:
        return None
    chosen = replace(DISPARITY, disparity_range=(low, high))
    found, correlation = _match_rows(first, second, valid0, valid1, chosen)
    chance = _match_by_chance(first, second, valid0, valid1, chosen)
    bounds = _correlation_bounds(correlation[found.matched], *chance, int(np.count_nonzero(valid0)))
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
        gaussian_blur(first, CORRELATION_SIGMA_PX),
        gaussian_blur(aligned, CORRELATION_SIGMA_PX),
        np.ones(first.shape, bool),
        CORRELATION_WINDOW_PX,
    )
    matched = DisparityMap(found.disparity, known, found.disparity_range)
    return matched, np.where(known, np.nan_to_num(correlation), np.float32(-1))


def _match_by_chance(
    first: np.ndarray,
    second: np.ndarray,
    valid0: np.ndarray,
    valid1: np.ndarray,
    disparity_options: DisparityOptions,
) -> tuple[np.ndarray, int]:
    """Return the correlations of matches by chance, and for how many pixels they were sought.

    Some rows are matched with rows of the second view that show something else: what is found there
    is found by chance, the best of as many disparities as everywhere.
    """
    height = len(first)
    count = max(1, round(height * NULL_FRACTION))
    start = (height - count) // 2
    rows = np.arange(start, start + count)
    others = (rows + height // 2) % height
    valid = valid0[rows], valid1[others]
    found, correlation = _match_rows(first[rows], second[others], *valid, disparity_options)
    return correlation[found.matched], int(np.count_nonzero(valid[0]))


def _correlation_bounds(
    correlations: np.ndarray,
    by_chance: np.ndarray,
    chance_pixels: int,
    pixels: int,
) -> tuple[float, float]:
    """Return the least correlation of a match that geometry relies on, and of one that is kept.

    Args:
        correlations: of the matches.
        by_chance: of matches by chance.
        chance_pixels, pixels: for how many pixels these and the matches were sought.
    """
    null = np.sort(by_chance)[::-1]
    allowed = int(FALSE_POSITIVE_RATE * chance_pixels)
    high = max(MIN_CORRELATION, float(null[allowed]) if len(null) > allowed else -1.0)
    # Where nearly nothing is found by chance and nearly all else is, low correlation is no reason
    # to doubt: smooth surfaces are matched by what surrounds them.
    ordered = np.sort(correlations)
    bounds = np.append(-1.0, null[::-1])
    matches = len(ordered) - np.searchsorted(ordered, bounds)
    wrong = (len(null) - np.searchsorted(null[::-1], bounds)) * pixels / max(chance_pixels, 1)
    few = bounds[(wrong <= FALSE_DISCOVERY_RATE * matches) & (chance_pixels > 0)]
    return high, min(high, float(few.min())) if len(few) else high


def _range_of_matches(
    frame: RectifiedFrame,
    points0: np.ndarray,
    points1: np.ndarray,
) -> Range:
    """Return the disparities of sparse matches, with a margin on both sides."""
    disparity = frame.to_frame(points0, 0)[:, 0] - frame.to_frame(points1, 1)[:, 0]
    disparity = disparity[np.isfinite(disparity)]
    if not len(disparity):
        return 0, 0
    smallest, largest = range_with_margin(disparity)
    if isinstance(frame, PolarFrame):
        if np.mean(disparity > 0) > MIN_FRACTION_OF_ONE_SIGN:
            smallest = max(smallest, -MARGIN_PX)
        if np.mean(disparity < 0) > MIN_FRACTION_OF_ONE_SIGN:
            largest = min(largest, MARGIN_PX)
    return int(np.floor(smallest)), int(np.ceil(largest))


def range_with_margin(disparity: np.ndarray) -> tuple[float, float]:
    """Return the range of most disparities, with a margin on both sides."""
    low, high = np.quantile(disparity, [TAIL_FRACTION, 1 - TAIL_FRACTION])
    margin = MARGIN_PX + MARGIN_FRACTION * (high - low)
    return float(low - margin), float(high + margin)
