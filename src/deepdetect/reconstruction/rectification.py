"""Whether a pair is rectified: matches lie on the same row of both images.

The rows are a model without any parameter. A pair is rectified when they explain about as many
matches as the best models with parameters do: a robust fundamental matrix, and rows that are
shifted, tilted and scaled. What fraction of all matches that is does not matter: many may be wrong.

Of large images small copies decide in a coarse pass where the answer is the same whatever they are
too coarse to show; else larger copies do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..features.selection import grid_subsample
from ..geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from ..geometry.two_view import SCENE_THRESHOLDS_PX, fit_model, is_planar, is_static
from ..matching.guided import TentativeMatches, find_tentative_matches

MAX_ROW_DISTANCE_PX = 1.0
"""Rows by which a match of a rectified pair may be off."""

MIN_INLIER_RATIO = 0.9
"""Matches on rows per match that the best other model explains."""

MIN_DISPARITY_SPREAD_PX = 2.0
"""Between the 5th and 95th percentile of the disparities of a pair with depth; whole pixels differ
by one for no reason."""

MIN_PLANAR_SPREAD_PX = 8.0
"""The same for a pair that one homography explains: a slanted plane has as much, a camera that
rotated a little does not."""

GRID_SIZE_PX = 8
"""Cells of the left image of this size give one match each."""

ITERATIONS = 500
"""Samples of three matches, for the rows that are shifted, tilted and scaled."""

SAMPLES_AT_ONCE = 100
"""Of these, whose rows are computed together, which bounds the memory."""

COARSE_SIDE_PX, COARSE_KEYPOINTS = 480, 1000
"""Longer side of the copies of the coarse pass, and keypoints of each."""

MIN_COARSE_INLIERS = 50
"""Matches of the coarse pass that a fundamental matrix explains, with fewer of which it does not
decide."""

MAX_COARSE_ROW_ERROR_PX = 0.6
"""A pair is rectified after the coarse pass only where its rows are off by less than this at
`MIN_INLIER_RATIO` of the matches. In pixels of the images themselves: many matches show together
what each is too coarse for."""


@dataclass(frozen=True)
class Rectification:
    """Whether a pair is rectified, and the figures that say so.

    Attributes:
        rectified: whether it is.
        reason: why not; empty when it is.
        swapped: it is rectified, but the left image was given as the right one: most disparities
            are negative.
        on_rows: number of matches (one per cell) within a row of each other, of `matches`.
        by_fundamental: number of them that the fundamental matrix explains as closely.
        by_other_rows: the same for the rows that are shifted, tilted and scaled.
        matches: number of matches that were used.
        vertical_offset: median of y in the second less y in the first image, in pixels, of those
            that the fundamental matrix explains.
        line_angle: largest angle between a row and an epipolar line, in degrees, at the corners
            of the second image; NaN without a fundamental matrix.
        disparities: 5th percentile, median and 95th percentile of those on rows, in pixels; NaN
            when there are none.
    """

    rectified: bool
    reason: str
    swapped: bool
    on_rows: int
    by_fundamental: int
    by_other_rows: int
    matches: int
    vertical_offset: float
    line_angle: float
    disparities: tuple[float, float, float]


def find_rectification(
    gray0: np.ndarray,
    gray1: np.ndarray,
    offset_px: float = 0.0,
    seed: int = 0,
) -> tuple[Rectification, TentativeMatches | None]:
    """Decide whether a pair of images is rectified, by the least effort that it takes.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        offset_px: what is added to a disparity before it gives the depth (calibration).
        seed: of the random samples.

    Returns:
        The decision, and the tentative matches of larger copies where they were needed for it.

    Example:
        >>> import cv2
        >>> noise = np.random.default_rng(0).integers(0, 256, (150, 200)).astype(np.uint8)
        >>> x, y = np.meshgrid(np.arange(200, dtype=np.float32), np.arange(150, dtype=np.float32))
        >>> moved = cv2.remap(noise, x + 4 + y / 5, y, cv2.INTER_LINEAR)
        >>> find_rectification(noise, moved)[0].rectified
        True
    """
    size0, size1 = gray0.shape[::-1], gray1.shape[::-1]
    if size0 != size1:
        nowhere = np.empty((0, 2))
        return detect_rectification(nowhere, nowhere, size0, size1, offset_px, seed), None
    if max(size0) > COARSE_SIDE_PX:
        found = _coarse_pass(gray0, gray1, offset_px, seed)
        if found is not None:
            return found, None
    tentative = find_tentative_matches(gray0, gray1)
    points = tentative.points0, tentative.points1
    return detect_rectification(*points, size0, size1, offset_px, seed), tentative


def _coarse_pass(
    gray0: np.ndarray, gray1: np.ndarray, offset_px: float, seed: int
) -> Rectification | None:
    """Decide from small copies of two images of one size; None where they leave it open."""
    coarse = find_tentative_matches(
        gray0, gray1, max_side_px=COARSE_SIDE_PX, max_keypoints=COARSE_KEYPOINTS
    )
    scale, size = coarse.scales[0], coarse.views[0].shape[::-1]
    # The thresholds are pixels of the copies: what they decide holds with a margin.
    found = detect_rectification(*coarse.matched, size, size, offset_px * scale, seed)
    if found.by_fundamental < MIN_COARSE_INLIERS:
        return None
    if found.rectified:
        on_rows = abs(found.disparities[1] + offset_px * scale) > MAX_ROW_DISTANCE_PX
        limit = MAX_COARSE_ROW_ERROR_PX * scale
        decided = on_rows and _row_error(*coarse.matched, seed) < limit
    else:
        best = max(found.by_fundamental, found.by_other_rows)
        # By three standard deviations of a binomial distribution.
        deviation = np.sqrt(best * MIN_INLIER_RATIO * (1 - MIN_INLIER_RATIO))
        decided = found.on_rows < MIN_INLIER_RATIO * best - 3 * deviation
    if not decided:
        return None
    low, median, high = (value / scale for value in found.disparities)
    return replace(
        found, vertical_offset=found.vertical_offset / scale, disparities=(low, median, high)
    )


def _row_error(points0: np.ndarray, points1: np.ndarray, seed: int) -> float:
    """Return by how much the rows of a pair that looks rectified are off at most of its matches.

    Not by the distance of each match from its row, which is as coarse as the matches, but by what
    all of them have in common: how that distance depends on the place (views that are turned, or
    bent by a lens) and on the disparity (a camera that moved up or down as well).
    """
    indices = grid_subsample(points0, GRID_SIZE_PX, seed)
    first, second = points0[indices], points1[indices]
    off, disparity = second[:, 1] - first[:, 1], first[:, 0] - second[:, 0]
    near = np.abs(off) <= MAX_ROW_DISTANCE_PX
    x, y = ((first[near] - first[near].mean(axis=0)) / np.ptp(first[near], axis=0).max()).T
    design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, disparity[near]])
    predicted = design @ np.linalg.lstsq(design, off[near], rcond=None)[0]
    return float(np.quantile(np.abs(predicted), MIN_INLIER_RATIO))


def detect_rectification(
    points0: np.ndarray,
    points1: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
    offset_px: float = 0.0,
    seed: int = 0,
) -> Rectification:
    """Decide from matches whether a pair is rectified.

    Args:
        points0, points1: (M, 2) matched positions in the left and the right image.
        size0, size1: (width, height) of the images.
        offset_px: what is added to a disparity before it gives the depth (calibration).
        seed: of the random samples.

    Example:
        >>> left = np.random.default_rng(0).uniform(0, (640, 480), (900, 2))
        >>> right = left - np.column_stack([20 + 5 * np.sin(left[:, 1] / 30), np.zeros(900)])
        >>> detect_rectification(left, right, (640, 480), (640, 480)).rectified
        True
        >>> detect_rectification(left, right + [0, 3], (640, 480), (640, 480)).rectified
        False
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    indices = grid_subsample(points0, GRID_SIZE_PX, seed)
    first, second = points0[indices], points1[indices]
    limit = MAX_ROW_DISTANCE_PX
    on_rows = np.abs(second[:, 1] - first[:, 1]) <= limit
    # Of a rectified pair Sampson's distance is that in rows over the root of 2.
    epipolar = fit_model(first, second, "fundamental", size1, limit / np.sqrt(2), seed)
    other_rows = _best_other_rows(first, second, size0, seed)
    disparity = (first - second)[on_rows, 0]
    spread = np.quantile(disparity, [0.05, 0.5, 0.95]) if len(disparity) else np.full(3, np.nan)
    vertical_offset = np.nan
    if epipolar.inliers.any():
        vertical_offset = float(np.median((second - first)[epipolar.inliers, 1]))
    counts = tuple(int(np.count_nonzero(part)) for part in (on_rows, epipolar.inliers, other_rows))
    # Rows are a line in every point; nothing was sampled, so this is on the safe side.
    alarms = log10_nfa(on_rows, "fundamental", limit, size1)
    if size0 != size1:
        reason = "the images differ in size"
    elif alarms > MAX_LOG10_NFA:
        reason = "hardly any match is on the same row in both images"
    else:
        reason = _reason(counts, vertical_offset, spread)
    if not reason and is_static(disparity):
        reason = "nothing moves between the images"
    if not reason and spread[2] - spread[0] < MIN_PLANAR_SPREAD_PX:
        threshold_px = SCENE_THRESHOLDS_PX["homography"]
        plane = fit_model(first, second, "homography", size1, threshold_px, seed)
        if is_planar(first, second, plane, epipolar, seed):
            reason = "one homography explains all the matches: all move nearly the same"
    on_rows_count, by_fundamental, by_other_rows = counts
    return Rectification(
        rectified=not reason,
        reason=reason,
        swapped=bool(not reason and spread[1] + offset_px < 0),
        on_rows=on_rows_count,
        by_fundamental=by_fundamental,
        by_other_rows=by_other_rows,
        matches=len(indices),
        vertical_offset=vertical_offset,
        line_angle=_line_angle(epipolar.matrix, size0),
        disparities=(float(spread[0]), float(spread[1]), float(spread[2])),
    )


def _reason(
    counts: tuple[int, ...],
    vertical_offset: float,
    spread: np.ndarray,
) -> str:
    """Return why rows are not the geometry of the pair; empty when they may be."""
    on_rows, by_fundamental, by_other_rows = counts
    best = max(by_fundamental, by_other_rows)
    if on_rows < MIN_INLIER_RATIO * best:
        return (
            f"only {on_rows:,} of {best:,} matches that agree are on the same row in both images "
            f"(median offset {vertical_offset:+.1f} px)"
        )
    if spread[2] - spread[0] < MIN_DISPARITY_SPREAD_PX:
        return f"all matches on rows have about the same disparity ({spread[1]:.3g} px)"
    return ""


def _best_other_rows(
    points0: np.ndarray,
    points1: np.ndarray,
    size: tuple[int, int],
    seed: int,
) -> np.ndarray:
    """Fit the vertical shift as a plane over the image, robustly; (M,) bool that agree with it.

    Three matches give it, where a fundamental matrix takes seven: it is found among many wrong
    matches too.
    """
    shift = points1[:, 1] - points0[:, 1]
    best = np.zeros(len(points0), bool)
    if len(points0) < 3:
        return best
    design = np.column_stack([points0 / max(size), np.ones(len(points0))])

    def agreeing(planes: np.ndarray) -> np.ndarray:
        agree: np.ndarray = np.abs(planes @ design.T - shift) <= MAX_ROW_DISTANCE_PX
        return agree

    samples = np.random.default_rng(seed).integers(0, len(points0), (ITERATIONS, 3))
    samples = samples[np.abs(np.linalg.det(design[samples])) >= 1e-4]
    for start in range(0, len(samples), SAMPLES_AT_ONCE):
        chosen = samples[start : start + SAMPLES_AT_ONCE]
        planes = np.linalg.solve(design[chosen], shift[chosen][..., None])[..., 0]
        agree = agreeing(planes)
        counts = np.count_nonzero(agree, axis=1)
        if counts.max() > np.count_nonzero(best):
            best = agree[np.argmax(counts)]
    if np.count_nonzero(best) >= 3:
        agree = agreeing(np.linalg.lstsq(design[best], shift[best], rcond=None)[0])
        if np.count_nonzero(agree) > np.count_nonzero(best):
            best = agree
    return best


def _line_angle(fundamental: np.ndarray | None, size: tuple[int, int]) -> float:
    """Return the largest angle between a row and an epipolar line at the corners, in degrees."""
    if fundamental is None:
        return float("nan")
    width, height = size
    corners = np.array([[x, y, 1.0] for x in (0, width - 1) for y in (0, height - 1)])
    lines = corners @ fundamental.T
    return float(np.degrees(np.arctan2(np.abs(lines[:, 0]), np.abs(lines[:, 1]))).max())
