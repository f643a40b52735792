"""Semi-global matching, and sub-pixel refinement of its disparities.

Hirschmüller, "Stereo processing by semi-global matching and mutual information" (PAMI 2008), with
census transforms (Zabih and Woodfill, ECCV 1994), which do not depend on brightness and contrast. A
parabola through the costs of three disparities gives sub-pixel disparities that are biased towards
integers. They only initialise a fit of the grey values along the row (Lucas and Kanade,
1981). `benchmarks/row_matching.py` measures the errors of both steps.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from ..._shared.machine import parallel_for
from ..._shared.opencv import cv2

CENSUS_RADIUS_X, CENSUS_RADIUS_Y = 4, 3
"""The census window has 9 x 7 pixels: 62 comparisons, which fit into a 64-bit word."""

CENSUS_BITS = (2 * CENSUS_RADIUS_X + 1) * (2 * CENSUS_RADIUS_Y + 1) - 1

WRONG_PLACE_BITS = CENSUS_BITS // 2
"""Average Hamming distance of a wrong match in bits: half of the census comparisons differ."""

COST_PER_BIT = 9 / 4
"""Cost of one bit of Hamming distance. A cost is the sum of the distances of 3 x 3 pixels, divided
by four to fit into a byte."""

LANES = 16
"""The number of disparities is rounded up to a multiple of this, for vector registers."""

VOLUME_BYTES, BAND_OVERLAP_PX = 400_000_000, 32
"""Cost volumes of more than VOLUME_BYTES are computed in bands of rows. Each band has
BAND_OVERLAP_PX further rows above and below, from which paths enter the band. Chosen by hand."""

SAMPLED_ROW_STEP = 48
"""The typical Hamming distance of matches is measured on every SAMPLED_ROW_STEP-th row."""

P1_BITS, P2_BITS, MIN_P2_BITS, P2_HALF_GRADIENT_LEVELS = 20, 100, 25, 8
"""Penalties, in census bits per pixel. `P1_BITS` is for a disparity that changes by one pixel along
a path. For larger changes, the penalty is `P2_BITS` where the grey level is constant, half of it
where neighbours differ by `P2_HALF_GRADIENT_LEVELS`, and at least `MIN_P2_BITS`. These are the best
of a few values on Middlebury's Motorcycle; noisy images of full size would need larger ones."""

OUTSIDE_COST = 0.6
"""Cost of a match outside the right image, where 0 is the pair's median match and 1 a wrong match.
This lets surfaces continue outside; a lower cost loses more of the border in noisy views."""

MAX_DIFFERENCE_PX = 1.0
"""Disparities of neighbours on one surface differ by at most this. Chosen by hand."""

WINDOW_RADIUS_PX = 2
"""Radius of the windows in which grey values are fitted. Chosen on Middlebury's Motorcycle."""

SMOOTHING_RADII_PX, FINAL_SMOOTHING_RADIUS_PX = (4, 4), 2
"""Radii of windows in which the disparities of one surface are averaged: before each iteration of
the fit, to reduce the bias of the parabola, and after the last iteration. Like `NOISE_LEVELS` and
`MIN_GAIN`, they were chosen on Middlebury's Motorcycle pair."""

NOISE_LEVELS = 2.0
"""Gradients below this, in grey levels per pixel, are noise: the averaged disparity is kept."""

MIN_GAIN = 0.2
"""Minimum of the factor by which the fit multiplies the right view's grey values to match the left
view. If the factor is lower, the right view shows something else: a disparity stays unrefined."""

UNKNOWN = np.float32(1e9)
"""This value stands for an unknown disparity: it is too large to share a surface with any other."""

Pair = tuple[np.ndarray, np.ndarray]

DisparityRange = tuple[int, int]
"""The smallest and the largest disparity that are tried, in integer pixels. The match of column x
in the left view is searched in columns x - largest to x - smallest of the right view."""


class SGMResult(NamedTuple):
    """Raw disparities of the left view, float32 in pixels, and how certain they are; (H, W) each.

    `consistent`: the match lies inside the right image, and both views agree on it within a pixel.
    `uniqueness_ratio`: the lowest cost of any other match inside the right image, more than a pixel
    away, divided by the cost of this match; 1 if this match lies outside.
    """

    disparity: np.ndarray
    consistent: np.ndarray
    uniqueness_ratio: np.ndarray


def semi_global_matching(
    left: np.ndarray, right: np.ndarray, disparities: DisparityRange
) -> SGMResult:
    """Match every pixel of the left view along its row; both views are (H, W) uint8 luma."""
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
    """Return the census transform of an (H, W) uint8 image, (H, W) uint64, a bit per neighbour."""
    from .kernels import census_rows

    x, y = CENSUS_RADIUS_X, CENSUS_RADIUS_Y
    padded = cv2.copyMakeBorder(gray, y, y, x, x, cv2.BORDER_REPLICATE)
    out = np.empty(gray.shape, np.uint64)
    parallel_for(len(gray), census_rows, padded, out)
    return out


def matching_cost(
    censuses: Pair, min_disparity: int, count: int, outside: int = WRONG_PLACE_BITS
) -> np.ndarray:
    """Return the costs of `count` disparities for each pixel, (H, W, count) uint8.

    `censuses` are those of the left and the right view. A cost is a quarter of the sum of the
    Hamming distances of 3 x 3 pixels; `outside` is the distance assumed outside the right view.
    """
    from .kernels import cost_rows

    left, right = censuses
    cost = np.empty((*left.shape, count), np.uint8)
    # Mirrored, the right view's pixels of rising disparities have rising addresses, for speed.
    mirrored = np.ascontiguousarray(right[:, ::-1])
    parallel_for(len(left), cost_rows, left, mirrored, min_disparity, np.uint8(outside), cost)
    return cost


def is_textured(gray: np.ndarray) -> np.ndarray:
    """Return which pixels have more than one grey level in their census window; (H, W) bool.

    All other pixels, for example in saturated, black or drawn areas, cannot be matched.
    """
    window = np.ones((2 * CENSUS_RADIUS_Y + 1, 2 * CENSUS_RADIUS_X + 1), np.uint8)
    return cv2.dilate(gray, window) > cv2.erode(gray, window)


def match_distance(censuses: Pair, disparities: DisparityRange) -> float:
    """Return the median Hamming distance of a pair's matches in bits, measured on some rows.

    Here, two pixels match if each has the least cost for the other, without sums along paths.
    """
    height = len(censuses[0])
    centres = np.arange(min(SAMPLED_ROW_STEP // 2, height // 2), height, SAMPLED_ROW_STEP)
    # Costs are sums over three rows. Matches outside the right view get the largest distance.
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
    """Refine known disparities, which are accurate to a pixel, to sub-pixel accuracy.

    The views are (H, W) uint8 luma; `disparity` is (H, W) float32 and unchanged where unknown.
    """
    from .kernels import sample_rows, step_rows

    gray, target = left.astype(np.float32), right.astype(np.float32)
    limits = np.array([MAX_DIFFERENCE_PX, NOISE_LEVELS, MIN_GAIN], np.float32)
    refined = disparity
    for radius in SMOOTHING_RADII_PX:
        start = _smoothed(refined, known, radius)
        values, gradient = np.empty_like(gray), np.empty_like(gray)
        parallel_for(len(gray), sample_rows, target, start, values, gradient)
        inputs = [_padded(each, WINDOW_RADIUS_PX) for each in (gray, values, gradient)]
        inputs.append(_padded(start, WINDOW_RADIUS_PX, known))
        refined = np.empty_like(gray)
        parallel_for(len(gray), step_rows, *inputs, WINDOW_RADIUS_PX, *limits, refined)
    return np.where(known, _smoothed(refined, known, FINAL_SMOOTHING_RADIUS_PX), disparity)


def _smoothed(disparity: np.ndarray, known: np.ndarray, radius: int) -> np.ndarray:
    """Return for each known pixel the mean disparity of its surface in a window, 0 elsewhere."""
    from .kernels import smooth_rows

    out = np.empty_like(disparity)
    padded = _padded(disparity, radius, known)
    parallel_for(len(out), smooth_rows, padded, radius, np.float32(MAX_DIFFERENCE_PX), out)
    return np.where(known, out, np.float32(0))


def _padded(values: np.ndarray, radius: int, known: np.ndarray | None = None) -> np.ndarray:
    """Pad an image with 0 or, if `known` is given, make added and unknown pixels `UNKNOWN`."""
    border = 0.0
    if known is not None:
        border, values = float(UNKNOWN), np.where(known, values, UNKNOWN)
    return cv2.copyMakeBorder(values, *(radius,) * 4, cv2.BORDER_CONSTANT, value=border)
