"""Semi-global matching: the disparity of every pixel of a rectified pair, to whole pixels.

After Hirschmüller, "Stereo processing by semi-global matching and mutual information" (PAMI 2008).
The cost of a disparity is the Hamming distance of census transforms (Zabih and Woodfill,
"Non-parametric local transforms for computing visual correspondence", ECCV 1994), which gain,
offset and gamma do not change, plus what its neighbours along eight straight paths add: P1 for a
disparity that changes by one pixel, P2 for a larger change, less where the grey level changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.opencv import cv2
from ..._shared.parallel import parallel_for

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
"""Cost of a place outside the right image, of which nothing is known.

0 is that of the pair's matches (their median), 1 that of a wrong place. Between them a surface that
leaves the image is carried on by its neighbours, and takes no wrong place inside. With less, more
of what is seen at the border is lost where views are noisy.
"""

DisparityRange = tuple[int, int]
"""The smallest and the largest disparity tried, in whole pixels: the match of a left (x, y) is
searched from the right x - largest to x - smallest."""


@dataclass(frozen=True, eq=False)
class SGMResult:
    """Raw disparities of the left view.

    Attributes:
        disparity: (H, W) float32 in pixels; it may lead outside the right image, where it is only
            that of the surface around.
        consistent: (H, W) bool: it leads inside, and both views agree on it within a pixel.
        uniqueness_ratio: (H, W) float32: the least cost of a place elsewhere on the row over the
            cost of this one, at least 1; 1 where it leads outside.
    """

    disparity: np.ndarray
    consistent: np.ndarray
    uniqueness_ratio: np.ndarray


def semi_global_matching(
    left: np.ndarray, right: np.ndarray, disparities: DisparityRange
) -> SGMResult:
    """Match every pixel of the left view along its row.

    Args:
        left, right: (H, W) uint8 luma of a rectified pair.
        disparities: those to try.

    Returns:
        The disparities, to sub-pixel by a parabola; these still cluster around whole pixels.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (40, 80), np.uint8)
        >>> found = semi_global_matching(scene[:, :60], scene[:, 5:65], (0, 15))
        >>> float(np.median(found.disparity[found.consistent]).round())
        5.0
    """
    height, width = left.shape
    count = -(-(disparities[1] - disparities[0] + 1) // LANES) * LANES
    censuses = census(left), census(right)
    match = _match_distance(*censuses, disparities)
    outside = round(match + OUTSIDE_COST * (WRONG_PLACE_BITS - match))
    found = SGMResult(
        disparity=np.zeros((height, width), np.float32),
        consistent=np.zeros((height, width), bool),
        uniqueness_ratio=np.ones((height, width), np.float32),
    )
    rows = max(VOLUME_BYTES // (3 * width * count) - 2 * BAND_OVERLAP_PX, BAND_OVERLAP_PX)
    if height <= rows + 2 * BAND_OVERLAP_PX:
        rows = height
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(top - BAND_OVERLAP_PX, 0), min(bottom + BAND_OVERLAP_PX, height)
        band = slice(first, last)
        bands = left[band], censuses[0][band], censuses[1][band]
        total = _aggregate(*bands, disparities[0], count, outside)
        inside = total[top - first : bottom - first]
        _select(inside, disparities, slice(top, bottom), found)
    return found


def census(gray: np.ndarray) -> np.ndarray:
    """Return the census transform of a (H, W) uint8 image, one bit per neighbour; uint64.

    Example:
        >>> image = np.full((20, 20), 7, np.uint8)
        >>> image[10, 10] = 9
        >>> [int(census(image)[row, 10]).bit_count() for row in (9, 10)]
        [0, 62]
    """
    from . import sgm_kernel as kernel

    x, y = CENSUS_RADIUS_X, CENSUS_RADIUS_Y
    padded = cv2.copyMakeBorder(gray, y, y, x, x, cv2.BORDER_REPLICATE)
    out = np.empty(gray.shape, np.uint64)
    parallel_for(len(gray), kernel.census_rows, padded, out)
    return out


def matching_cost(
    left: np.ndarray,
    right: np.ndarray,
    min_disparity: int,
    count: int,
    outside: int = WRONG_PLACE_BITS,
) -> np.ndarray:
    """Compute the cost of each of so many disparities of each pixel of two censuses.

    Returns:
        (H, W, count) uint8, a quarter of the sum of the distances over 3 x 3 pixels; `outside` is
        that of a place outside the right view.

    Example:
        >>> words = np.zeros((8, 30), np.uint64)
        >>> words[4, 20] = 2**62 - 1
        >>> int(matching_cost(words, np.roll(words, -5, axis=1), 0, 16)[4, 20].argmin())
        5
    """
    from . import sgm_kernel as kernel

    cost = np.empty((*left.shape, count), np.uint8)
    # Mirrored, growing disparities lie at growing addresses.
    mirrored = np.ascontiguousarray(right[:, ::-1])
    parallel_for(
        len(left), kernel.cost_rows, left, mirrored, min_disparity, np.uint8(outside), cost
    )
    return cost


def is_textured(gray: np.ndarray) -> np.ndarray:
    """Return the pixels whose census window holds more than one grey level; (H, W) bool.

    Others have nothing to be matched by: they are saturated, black, or drawn.

    Example:
        >>> image = np.full((20, 20), 7, np.uint8)
        >>> image[10, 10] = 20
        >>> int(is_textured(image).sum())
        63
    """
    window = np.ones((2 * CENSUS_RADIUS_Y + 1, 2 * CENSUS_RADIUS_X + 1), np.uint8)
    return cv2.dilate(gray, window) > cv2.erode(gray, window)


def _match_distance(left: np.ndarray, right: np.ndarray, disparities: DisparityRange) -> float:
    """Return the median distance in bits of a pair's matches, from the censuses of some rows.

    Matches are what both views find nearest without any path. Noise makes them more distant.
    """
    from . import sgm_kernel as kernel

    height, width = left.shape
    centres = np.arange(min(SAMPLED_ROW_STEP // 2, height // 2), height, SAMPLED_ROW_STEP)
    # Costs are sums over three rows. Places outside are the most distant.
    rows = np.clip(centres[:, None] + [-1, 0, 1], 0, height - 1).ravel()
    tried = disparities[0], disparities[1] - disparities[0] + 1
    cost = matching_cost(left[rows], right[rows], *tried, CENSUS_BITS)[1::3]
    disparity, ratio = np.empty((2, len(centres), width), np.float32)
    agreed = np.empty(ratio.shape, bool)
    parallel_for(
        len(cost), kernel.best_of_rows, cost.astype(np.uint16), *tried, disparity, agreed, ratio
    )
    distances = cost.min(axis=2)[agreed & (ratio > 1)] / COST_PER_BIT
    return (
        min(float(np.median(distances)), WRONG_PLACE_BITS) if len(distances) else WRONG_PLACE_BITS
    )


def _aggregate(
    gray: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
    min_disparity: int,
    count: int,
    outside: int = WRONG_PLACE_BITS,
) -> np.ndarray:
    """Return the (H, W, D) uint16 costs of a pair's censuses, summed over the eight paths."""
    from . import sgm_kernel as kernel

    height, width = gray.shape
    cost = matching_cost(left, right, min_disparity, count, outside)
    total = np.zeros(cost.shape, np.uint16)
    p1 = np.uint16(P1_BITS * COST_PER_BIT)
    p2 = P2_BITS / (1 + np.arange(256) / P2_HALF_GRADIENT_LEVELS)
    p2 = np.maximum(p2, MIN_P2_BITS)
    penalties = (p1, (p2 * COST_PER_BIT).astype(np.uint16))
    volumes = (gray, cost, total)
    for direction in (1, -1):
        parallel_for(height, kernel.sum_along_rows, *volumes, direction, *penalties)
        for slant in (-1, 0, 1):
            parallel_for(width, kernel.sum_along_columns, *volumes, direction, slant, *penalties)
    return total


def _select(total: np.ndarray, disparities: DisparityRange, rows: slice, found: SGMResult) -> None:
    """Write the best disparities of a cost volume into the rows of the result that it covers."""
    from . import sgm_kernel as kernel

    outputs = (found.disparity[rows], found.consistent[rows], found.uniqueness_ratio[rows])
    tried = disparities[0], disparities[1] - disparities[0] + 1
    parallel_for(len(total), kernel.best_of_rows, total, *tried, *outputs)
