"""Semi-global matching, and the refinement of its disparities to sub-pixels.

Hirschmüller, "Stereo processing by semi-global matching and mutual information" (PAMI 2008), with
census transforms (Zabih and Woodfill, ECCV 1994), which the light does not change. The parabola
through the costs of three disparities pulls towards whole pixels, so it only starts a fit of the
grey values along the row (Lucas and Kanade, 1981): `benchmarks/row_matching.py` measures both.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from ..._shared.machine import parallel_for
from ..._shared.opencv import cv2

CENSUS_RADIUS_X = 4
CENSUS_RADIUS_Y = 3
"""The census window is 9 x 7 pixels: 62 comparisons, which fit a 64-bit word."""

CENSUS_BITS = (2 * CENSUS_RADIUS_X + 1) * (2 * CENSUS_RADIUS_Y + 1) - 1

WRONG_PLACE_BITS = CENSUS_BITS // 2
"""Distance of a wrong place on average: half of the comparisons differ."""

COST_PER_BIT = 9 / 4
"""Costs are sums over 3 x 3 pixels, divided by four to fit a byte."""

LANES = 16
"""The number of disparities is rounded up to a multiple of this, for vector registers."""

VOLUME_BYTES = 400_000_000
"""Larger cost volumes are processed in bands of rows, one after the other."""

SAMPLED_ROW_STEP = 48
"""One row of so many says how distant matches are."""

BAND_OVERLAP_PX = 32
"""Rows above and below a band from which paths enter it."""

# The penalties are the best of a few tried on the Motorcycle pair; noisy images of full size would
# take larger ones.
P1_BITS = 20
"""Penalty of a disparity that changes by one pixel along a path, in census bits per pixel."""

P2_BITS = 100
"""Penalty of a larger change, where the grey level does not change."""

P2_HALF_GRADIENT_LEVELS = 8
"""Change of the grey level that halves P2."""

MIN_P2_BITS = 1.25 * P1_BITS

OUTSIDE_COST = 0.6
"""Cost of a place outside the right image: 0 is that of the pair's matches (their median), 1 that
of a wrong place. Between them a surface that leaves the image is carried on by its neighbours; with
less, more of what is seen at the border is lost where views are noisy."""

MAX_DIFFERENCE_PX = 1.0
"""A disparity that differs by more from its neighbour's belongs to another surface."""

WINDOW_RADIUS_PX = 2
"""Windows of 5 pixels a side are fitted."""

SMOOTHING_RADIUS_PX = 4
"""Of the mean of the same surface before each iteration: it undoes most of the parabola's pull."""

FINAL_SMOOTHING_RADIUS_PX = 2
"""Of the mean taken at the end."""

ITERATIONS = 2
"""Of the fit."""

NOISE_LEVELS = 2.0
"""Grey levels; where the image has no stronger gradients the smoothed surface stays."""

MIN_GAIN = 0.2
"""Least contrast of the right view over the left: below, it shows something else: no refinement."""

UNKNOWN = np.float32(1e9)
"""An unknown disparity, so far from any other that it is never on the same surface."""

Pair = tuple[np.ndarray, np.ndarray]

DisparityRange = tuple[int, int]
"""The smallest and the largest disparity tried, in whole pixels: the match of a left (x, y) is
searched from the right x - largest to x - smallest."""


class SGMResult(NamedTuple):
    """Raw disparities of the left view, (H, W) each: float32 in pixels, and how sure they are.

    `consistent`: it leads inside the right image, and both views agree on it within a pixel.
    `uniqueness_ratio`: the least cost elsewhere inside over the cost of this place; 1 outside.
    """

    disparity: np.ndarray
    consistent: np.ndarray
    uniqueness_ratio: np.ndarray


def semi_global_matching(
    left: np.ndarray, right: np.ndarray, disparities: DisparityRange
) -> SGMResult:
    """Match every pixel of the left view, (H, W) uint8 luma, along its row.

    The disparities are sub-pixel by a parabola, and still cluster around whole pixels.
    """
    height, width = left.shape
    count = -(-(disparities[1] - disparities[0] + 1) // LANES) * LANES
    censuses = census(left), census(right)
    match = match_distance(censuses, disparities)
    outside = round(match + OUTSIDE_COST * (WRONG_PLACE_BITS - match))
    rows = max(VOLUME_BYTES // (3 * width * count) - 2 * BAND_OVERLAP_PX, BAND_OVERLAP_PX)
    if height <= rows + 2 * BAND_OVERLAP_PX:
        rows = height
    parts = []
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first = max(top - BAND_OVERLAP_PX, 0)
        band = slice(first, min(bottom + BAND_OVERLAP_PX, height))
        in_band = censuses[0][band], censuses[1][band]
        total = aggregate(left[band], matching_cost(in_band, disparities[0], count, outside))
        parts.append(_least_costs(total[top - first : bottom - first], disparities))
    return SGMResult(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _least_costs(total: np.ndarray, disparities: DisparityRange) -> SGMResult:
    """Choose the disparities of the least (H, W, D) uint16 sums of costs."""
    from .kernels import best_of_rows

    disparity, ratio = np.empty((2, *total.shape[:2]), np.float32)
    result = SGMResult(disparity, np.empty(disparity.shape, bool), ratio)
    tried = disparities[0], disparities[1] - disparities[0] + 1
    parallel_for(len(total), best_of_rows, total, *tried, *result)
    return result


def census(gray: np.ndarray) -> np.ndarray:
    """Return the census transform of a (H, W) uint8 image, one bit per neighbour; uint64."""
    from .kernels import census_rows

    x, y = CENSUS_RADIUS_X, CENSUS_RADIUS_Y
    padded = cv2.copyMakeBorder(gray, y, y, x, x, cv2.BORDER_REPLICATE)
    out = np.empty(gray.shape, np.uint64)
    parallel_for(len(gray), census_rows, padded, out)
    return out


def matching_cost(
    censuses: Pair, min_disparity: int, count: int, outside: int = WRONG_PLACE_BITS
) -> np.ndarray:
    """Return the cost of so many disparities of each pixel of two censuses, (H, W, count) uint8.

    A quarter of the sum over 3 x 3 pixels; `outside` is the distance to places off the right view.
    """
    from .kernels import cost_rows

    left, right = censuses
    cost = np.empty((*left.shape, count), np.uint8)
    # Mirrored, growing disparities lie at growing addresses.
    mirrored = np.ascontiguousarray(right[:, ::-1])
    parallel_for(len(left), cost_rows, left, mirrored, min_disparity, np.uint8(outside), cost)
    return cost


def is_textured(gray: np.ndarray) -> np.ndarray:
    """Return the pixels whose census window holds more than one grey level; (H, W) bool.

    Others have nothing to be matched by: they are saturated, black, or drawn.
    """
    window = np.ones((2 * CENSUS_RADIUS_Y + 1, 2 * CENSUS_RADIUS_X + 1), np.uint8)
    return cv2.dilate(gray, window) > cv2.erode(gray, window)


def match_distance(censuses: Pair, disparities: DisparityRange) -> float:
    """Return the median distance in bits of a pair's matches, from the censuses of some rows.

    Matches are what both views find nearest without any path. Noise makes them more distant.
    """
    height = len(censuses[0])
    centres = np.arange(min(SAMPLED_ROW_STEP // 2, height // 2), height, SAMPLED_ROW_STEP)
    # Costs are sums over three rows. Places outside are the most distant.
    rows = np.clip(centres[:, None] + [-1, 0, 1], 0, height - 1).ravel()
    tried = disparities[0], disparities[1] - disparities[0] + 1
    sampled = censuses[0][rows], censuses[1][rows]
    cost = matching_cost(sampled, *tried, CENSUS_BITS)[1::3]
    nearest = _least_costs(cost.astype(np.uint16), disparities)
    matched = nearest.consistent & (nearest.uniqueness_ratio > 1)
    distances = cost.min(axis=2)[matched] / COST_PER_BIT
    typical = float(np.median(distances)) if len(distances) else np.inf
    return min(typical, WRONG_PLACE_BITS)


def aggregate(gray: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Return (H, W, D) uint8 costs summed over the eight paths, uint16."""
    from .kernels import sum_along_paths

    height, width = gray.shape
    total = np.zeros(cost.shape, np.uint16)
    p2 = np.maximum(P2_BITS / (1 + np.arange(256) / P2_HALF_GRADIENT_LEVELS), MIN_P2_BITS)
    penalties = np.uint16(P1_BITS * COST_PER_BIT), (p2 * COST_PER_BIT).astype(np.uint16)
    for direction in product((-1, 0, 1), repeat=2):
        if any(direction):
            paths = width if direction[0] else height
            parallel_for(paths, sum_along_paths, gray, cost, total, *direction, *penalties)
    return total


def refine_disparity(
    left: np.ndarray, right: np.ndarray, disparity: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Refine disparities that are accurate to a pixel, where they are known, to sub-pixels.

    The views are (H, W) uint8 luma; `disparity` is (H, W) float32, unchanged where not known.
    """
    from .kernels import sample_rows, step_rows

    gray, target = left.astype(np.float32), right.astype(np.float32)
    padded = _padded(gray, WINDOW_RADIUS_PX)
    limits = np.array([MAX_DIFFERENCE_PX, NOISE_LEVELS, MIN_GAIN], np.float32)
    refined = disparity
    for _ in range(ITERATIONS):
        start = _smoothed(refined, known, SMOOTHING_RADIUS_PX)
        values, gradient = np.empty_like(gray), np.empty_like(gray)
        parallel_for(len(gray), sample_rows, target, start, values, gradient)
        inputs = (
            padded,
            _padded(values, WINDOW_RADIUS_PX),
            _padded(gradient, WINDOW_RADIUS_PX),
            _padded(start, WINDOW_RADIUS_PX, known),
        )
        refined = np.empty_like(gray)
        parallel_for(len(gray), step_rows, *inputs, WINDOW_RADIUS_PX, *limits, refined)
    return np.where(known, _smoothed(refined, known, FINAL_SMOOTHING_RADIUS_PX), disparity)


def _smoothed(disparity: np.ndarray, known: np.ndarray, radius: int) -> np.ndarray:
    """Return the mean disparity of the same surface around each known pixel, 0 elsewhere."""
    from .kernels import smooth_rows

    out = np.empty_like(disparity)
    padded = _padded(disparity, radius, known)
    parallel_for(len(out), smooth_rows, padded, radius, np.float32(MAX_DIFFERENCE_PX), out)
    return np.where(known, out, np.float32(0))


def _padded(values: np.ndarray, radius: int, known: np.ndarray | None = None) -> np.ndarray:
    """Pad an image; disparities that are not known are marked, those of the border too."""
    border = 0.0
    if known is not None:
        border, values = float(UNKNOWN), np.where(known, values, UNKNOWN)
    return cv2.copyMakeBorder(values, *(radius,) * 4, cv2.BORDER_CONSTANT, value=border)
