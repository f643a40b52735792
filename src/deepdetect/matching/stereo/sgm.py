"""Semi-global matching, and sub-pixel refinement of its disparities.

Hirschmüller, "Stereo processing by semi-global matching and mutual information" (PAMI 2008), with
census transforms (Zabih and Woodfill, ECCV 1994), which are invariant to the light. A parabola
through the costs of three disparities is biased towards whole pixels. So it only starts a fit of
the grey values along the row (Lucas and Kanade, 1981); `benchmarks/row_matching.py` measures both.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from ..._shared.machine import parallel_for
from ..._shared.opencv import cv2

CENSUS_RADIUS_X = 4
CENSUS_RADIUS_Y = 3
"""The census window has 9 x 7 pixels: 62 comparisons, which fit into a 64-bit word."""

CENSUS_BITS = (2 * CENSUS_RADIUS_X + 1) * (2 * CENSUS_RADIUS_Y + 1) - 1

WRONG_PLACE_BITS = CENSUS_BITS // 2
"""Average distance of a wrong match: half of the comparisons differ."""

COST_PER_BIT = 9 / 4
"""A cost is the sum over 3 x 3 pixels, divided by four to fit into a byte."""

LANES = 16
"""The number of disparities is rounded up to a multiple of this, for vector registers."""

VOLUME_BYTES = 400_000_000
"""Larger cost volumes are processed in bands of rows, one after the other."""

SAMPLED_ROW_STEP = 48
"""One row in this many is sampled for the typical distance of matches. Chosen by hand."""

BAND_OVERLAP_PX = 32
"""Paths enter a band from this many rows above and below it. Chosen by hand."""

# The penalties are the best of a few that were tried on the Motorcycle pair. Noisy images of full
# size would need larger ones.
P1_BITS = 20
"""Penalty for a disparity that changes by one pixel along a path, in census bits per pixel."""

P2_BITS = 100
"""Penalty for a larger change where the grey level is constant, in the same unit."""

P2_HALF_GRADIENT_LEVELS = 8
"""Difference of grey levels at which P2 is halved."""

MIN_P2_BITS = 1.25 * P1_BITS

OUTSIDE_COST = 0.6
"""Cost of a match outside the right image. The cost is 0 for the median of the pair's matches, and
1 for a wrong match. In between, a surface that leaves the image is continued from its neighbours.
With less, more content at the border is lost in noisy views."""

MAX_DIFFERENCE_PX = 1.0
"""Neighbouring disparities that differ by more are on different surfaces. Chosen by hand."""

WINDOW_RADIUS_PX = 2
"""Radius of the fitted windows. It and the next five values were chosen on the Motorcycle pair."""

SMOOTHING_RADIUS_PX = 4
"""Radius of the mean over one surface before each iteration, against the parabola's bias."""

FINAL_SMOOTHING_RADIUS_PX = 2
"""Radius of the mean over one surface at the end."""

ITERATIONS = 2
"""Number of iterations of the fit."""

NOISE_LEVELS = 2.0
"""Gradients below this are noise, in grey levels per pixel: the smoothed surface is then kept."""

MIN_GAIN = 0.2
"""Minimum contrast of the right view relative to the left. Below it the right view shows something
else, and the disparity is not refined."""

UNKNOWN = np.float32(1e9)
"""An unknown disparity, so far from any other that it is never on the same surface."""

Pair = tuple[np.ndarray, np.ndarray]

DisparityRange = tuple[int, int]
"""The smallest and the largest disparity tried, in whole pixels: the match of a left (x, y) is
searched from the right x - largest to x - smallest."""


class SGMResult(NamedTuple):
    """Raw disparities of the left view, (H, W) each: float32 in pixels, and how certain they are.

    `consistent`: the match lies inside the right image, and both views agree on it within a pixel.
    `uniqueness_ratio`: lowest cost of any other match inside over that of this match; 1 outside.
    """

    disparity: np.ndarray
    consistent: np.ndarray
    uniqueness_ratio: np.ndarray


def semi_global_matching(
    left: np.ndarray, right: np.ndarray, disparities: DisparityRange
) -> SGMResult:
    """Match every pixel of the left view, (H, W) uint8 luma, along its row.

    A parabola makes the disparities sub-pixel, but they still cluster around whole pixels.
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
    """Choose the disparities of lowest cost from the sums of costs, (H, W, D) uint16."""
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
    """Return the costs of `count` disparities for each pixel of two censuses, (H, W, count) uint8.

    A cost is a quarter of the sum over 3 x 3 pixels; `outside` is the distance outside the image.
    """
    from .kernels import cost_rows

    left, right = censuses
    cost = np.empty((*left.shape, count), np.uint8)
    # In the mirrored view, larger disparities are at higher addresses.
    mirrored = np.ascontiguousarray(right[:, ::-1])
    parallel_for(len(left), cost_rows, left, mirrored, min_disparity, np.uint8(outside), cost)
    return cost


def is_textured(gray: np.ndarray) -> np.ndarray:
    """Return the pixels whose census window has more than one grey level; (H, W) bool.

    All other pixels, which are saturated, black or drawn, cannot be matched.
    """
    window = np.ones((2 * CENSUS_RADIUS_Y + 1, 2 * CENSUS_RADIUS_X + 1), np.uint8)
    return cv2.dilate(gray, window) > cv2.erode(gray, window)


def match_distance(censuses: Pair, disparities: DisparityRange) -> float:
    """Return the median distance of a pair's matches in bits, from the censuses of some rows.

    A match here has the least cost in both views, without paths. Noise increases its distance.
    """
    height = len(censuses[0])
    centres = np.arange(min(SAMPLED_ROW_STEP // 2, height // 2), height, SAMPLED_ROW_STEP)
    # Costs are sums over three rows. Matches outside get the largest distance.
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
    """Sum (H, W, D) uint8 costs along paths of eight directions; return uint16."""
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
    """Refine disparities that are accurate to a pixel to sub-pixel accuracy where they are known.

    The views are (H, W) uint8 luma; `disparity` is (H, W) float32 and unchanged where unknown.
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
    """Return the mean disparity over the same surface around each known pixel, 0 elsewhere."""
    from .kernels import smooth_rows

    out = np.empty_like(disparity)
    padded = _padded(disparity, radius, known)
    parallel_for(len(out), smooth_rows, padded, radius, np.float32(MAX_DIFFERENCE_PX), out)
    return np.where(known, out, np.float32(0))


def _padded(values: np.ndarray, radius: int, known: np.ndarray | None = None) -> np.ndarray:
    """Pad an image; unknown disparities and those of the border become `UNKNOWN`."""
    border = 0.0
    if known is not None:
        border, values = float(UNKNOWN), np.where(known, values, UNKNOWN)
    return cv2.copyMakeBorder(values, *(radius,) * 4, cv2.BORDER_CONSTANT, value=border)
