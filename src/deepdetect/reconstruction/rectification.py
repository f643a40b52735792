"""Whether a pair is rectified: matches lie on the same row of both images.

The rows are a model without any parameter. A pair is rectified when they explain about as many
matches as the best models with parameters do: a robust fundamental matrix, and rows that are
moved, tilted and spread. What share of all matches that is does not matter: many may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..features.selection import grid_subsample
from ..geometry import GeometryOptions, estimate_geometry
from ..geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from .checks import PLANE_THRESHOLD, is_flat, stands_still

ROWS = 1.0
"""Rows by which a match of a rectified pair may be off."""

AS_MANY = 0.9
"""Share of the matches of the best other model that the rows must explain."""

LEAST_SPREAD = 2.0
"""Pixels between the 5th and 95th percentile of the disparities of a pair with depth; whole pixels
differ by one for nothing."""

PLANE_SPREAD = 8.0
"""The same for a pair that one homography explains: a slanted plane has as much, a camera that
turned a little does not."""

CELL = 8
"""Side in pixels of the cells of the left image that give one match each."""

DRAWS = 500
"""Samples of three matches for the rows that are moved, tilted and spread."""


@dataclass(frozen=True)
class Rectification:
    """Whether a pair is rectified, and the figures that say so.

    Attributes:
        rectified: whether it is.
        reason: why not; empty when it is.
        swapped: it is rectified, but the left image was given as the right one: most disparities
            are negative.
        on_rows: number of matches (one a cell) within a row of each other, of `matches`.
        by_fundamental: number of them that the fundamental matrix explains as closely.
        by_other_rows: the same for the rows that are moved, tilted and spread.
        matches: number of matches that were looked at.
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


def judge_rectification(
    points0: np.ndarray,
    points1: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
    offset_px: float = 0.0,
    seed: int = 0,
) -> Rectification:
    """Tell from matches whether a pair is rectified.

    Args:
        points0, points1: (M, 2) matched positions in the left and the right image.
        size0, size1: (width, height) of the images.
        offset_px: what is added to a disparity before it tells the depth (calibration).
        seed: of the random samples.

    Example:
        >>> left = np.random.default_rng(0).uniform(0, (640, 480), (900, 2))
        >>> right = left - np.column_stack([20 + 5 * np.sin(left[:, 1] / 30), np.zeros(900)])
        >>> judge_rectification(left, right, (640, 480), (640, 480)).rectified
        True
        >>> judge_rectification(left, right + [0, 3], (640, 480), (640, 480)).rectified
        False
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    rows = grid_subsample(points0, CELL, seed)
    first, second = points0[rows], points1[rows]
    vertical = np.abs(second[:, 1] - first[:, 1])
    level = vertical <= ROWS
    # Of a rectified pair Sampson's distance is that in rows over the root of 2.
    options = GeometryOptions(inlier_threshold=ROWS / np.sqrt(2), seed=seed)
    space = estimate_geometry(first, second, options)
    other = _best_other_rows(first, second, size0, seed)
    disparity = (first - second)[level, 0]
    spread = np.quantile(disparity, [0.05, 0.5, 0.95]) if len(disparity) else np.full(3, np.nan)
    offset = np.nan
    if space.inliers.any():
        offset = float(np.median((second - first)[space.inliers, 1]))
    counts = tuple(int(np.count_nonzero(part)) for part in (level, space.inliers, other))
    # Rows are a line in every point; nothing was drawn, so this is on the safe side.
    alarms = log10_nfa(np.where(level, 0, np.inf), "fundamental", ROWS, size1)
    reason = _reason(size0, size1, alarms, counts, offset, spread)
    if not reason and stands_still(disparity):
        reason = "nothing moves between the images"
    if not reason and spread[2] - spread[0] < PLANE_SPREAD:
        plane = GeometryOptions(model="homography", inlier_threshold=PLANE_THRESHOLD, seed=seed)
        if is_flat(estimate_geometry(first, second, plane).inliers, space.inliers):
            reason = "one homography explains all the matches: they move nearly alike"
    return Rectification(
        not reason,
        reason,
        bool(not reason and spread[1] + offset_px < 0),
        *counts,
        len(rows),
        offset,
        _line_angle(space.matrix, size0),
        (float(spread[0]), float(spread[1]), float(spread[2])),
    )


def _reason(
    size0: tuple[int, int],
    size1: tuple[int, int],
    alarms: float,
    counts: tuple[int, ...],
    offset: float,
    spread: np.ndarray,
) -> str:
    on_rows, by_fundamental, by_other_rows = counts
    if size0 != size1:
        return "the images differ in size"
    if alarms > MAX_LOG10_NFA:
        return "hardly any match is on the same row in both images"
    best = max(by_fundamental, by_other_rows)
    if on_rows < AS_MANY * best:
        return (
            f"only {on_rows:,} of {best:,} matches that agree are on the same row in both images "
            f"(median offset {offset:+.1f} px)"
        )
    if spread[2] - spread[0] < LEAST_SPREAD:
        return f"all matches on rows have about the same disparity ({spread[1]:.3g} px)"
    return ""


def _best_other_rows(
    points0: np.ndarray, points1: np.ndarray, size: tuple[int, int], seed: int
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
    generator = np.random.default_rng(seed)
    for _ in range(DRAWS):
        drawn = generator.integers(0, len(points0), 3)
        if abs(np.linalg.det(design[drawn])) < 1e-4:
            continue
        plane = np.linalg.solve(design[drawn], shift[drawn])
        agree = np.abs(design @ plane - shift) <= ROWS
        if np.count_nonzero(agree) > np.count_nonzero(best):
            best = agree
    if np.count_nonzero(best) >= 3:
        plane = np.linalg.lstsq(design[best], shift[best], rcond=None)[0]
        agree = np.abs(design @ plane - shift) <= ROWS
        if np.count_nonzero(agree) > np.count_nonzero(best):
            best = agree
    return best


def _line_angle(fundamental: np.ndarray | None, size: tuple[int, int]) -> float:
    if fundamental is None:
        return float("nan")
    width, height = size
    corners = np.array([[x, y, 1.0] for x in (0, width - 1) for y in (0, height - 1)])
    lines = corners @ fundamental.T
    return float(np.degrees(np.arctan2(np.abs(lines[:, 0]), np.abs(lines[:, 1]))).max())
