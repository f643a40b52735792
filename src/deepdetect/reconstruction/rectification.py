"""Whether a pair is rectified: matches lie on the same row of both images.

The rows are a model without any parameter. A pair is rectified when they explain about as many
matches as the best models with parameters do: a robust fundamental matrix, and rows that are
shifted, tilted and scaled. What fraction of all matches that is does not matter: many may be wrong.

Of large images small copies are looked at first. They decide where the answer is the same whatever
they are too coarse to show; else larger copies do.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from .._shared.options import check_ranges, suggest_keywords
from ..features.selection import grid_subsample
from ..geometry import GeometryOptions, estimate_geometry
from ..geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from ..matching.guided import TentativeMatches, tentative_matches
from ..matching.guided.options import InitialGeometryOptions
from .checks import StaticOptions, is_planar, is_static

SAMPLES_AT_ONCE = 100
"""Of three matches whose rows are computed together, which bounds the memory."""


@suggest_keywords
@dataclass(frozen=True)
class RectificationOptions:
    """When a pair counts as rectified.

    Attributes:
        max_row_distance_px: rows by which a match of a rectified pair may be off.
        min_inlier_ratio: matches on rows per match that the best other model explains.
        min_disparity_spread_px: between the 5th and 95th percentile of the disparities of a pair
            with depth; whole pixels differ by one for no reason.
        min_planar_spread_px: the same for a pair that one homography explains: a slanted plane has
            as much, a camera that rotated a little does not.
        max_transfer_error_px: within which a match agrees with the homography.
        min_planar_ratio: matches of the homography per match of the fundamental matrix, of a plane.
        grid_size_px: cells of the left image of this size give one match each.
        iterations: samples of three matches, for the rows that are shifted, tilted and scaled.
        static: when nothing moves.
        first_side_px: longer sides are scaled down to this for a first look.
        first_max_keypoints: of each image in the first look.
        min_first_inliers: matches of the first look that a fundamental matrix explains, with fewer
            of which it does not decide.
        max_first_row_error_px: a pair is rectified after the first look only where its rows are off
            by less than this at `min_inlier_ratio` of the matches. It is in pixels of the images
            themselves: many matches show together what each is too coarse for.

    Raises:
        OptionError: a value is out of its range.
    """

    max_row_distance_px: float = 1.0
    min_inlier_ratio: float = 0.9
    min_disparity_spread_px: float = 2.0
    min_planar_spread_px: float = 8.0
    max_transfer_error_px: float = 2.0
    min_planar_ratio: float = 0.75
    grid_size_px: int = 8
    iterations: int = 500
    static: StaticOptions = field(default_factory=StaticOptions)
    first_side_px: int = 480
    first_max_keypoints: int = 1000
    min_first_inliers: int = 50
    max_first_row_error_px: float = 0.6

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("max_row_distance_px", "max_transfer_error_px", "grid_size_px", "iterations"),
                *("first_side_px", "first_max_keypoints", "min_first_inliers"),
            ),
            not_negative=(
                *("min_inlier_ratio", "min_planar_ratio", "max_first_row_error_px"),
                *("min_disparity_spread_px", "min_planar_spread_px"),
            ),
        )


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
    options: RectificationOptions = RectificationOptions(),
) -> tuple[Rectification, TentativeMatches | None]:
    """Decide whether a pair of images is rectified, by the least effort that it takes.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        offset_px: what is added to a disparity before it gives the depth (calibration).
        seed: of the random samples.
        options: the thresholds.

    Returns:
        The decision, and the sparse matches of larger copies where they were needed for it.

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
        return detect_rectification(nowhere, nowhere, size0, size1, offset_px, seed, options), None
    if max(size0) > options.first_side_px:
        found = _first_look(gray0, gray1, offset_px, seed, options)
        if found is not None:
            return found, None
    initial = tentative_matches(gray0, gray1)
    points = initial.points0, initial.points1
    return detect_rectification(*points, size0, size1, offset_px, seed, options), initial


def _first_look(
    gray0: np.ndarray,
    gray1: np.ndarray,
    offset_px: float,
    seed: int,
    options: RectificationOptions,
) -> Rectification | None:
    """Decide from small copies of two images of one size; None where they leave it open."""
    coarse = InitialGeometryOptions(max_side_px=options.first_side_px)
    coarse = replace(coarse, sift=replace(coarse.sift, max_keypoints=options.first_max_keypoints))
    initial = tentative_matches(gray0, gray1, options=coarse)
    scale, size = initial.scales[0], initial.views[0].shape[::-1]
    # The thresholds are pixels of the copies: what they decide holds with a margin.
    found = detect_rectification(*initial.matched, size, size, offset_px * scale, seed, options)
    if found.by_fundamental < options.min_first_inliers:
        return None
    if found.rectified:
        on_rows = abs(found.disparities[1] + offset_px * scale) > options.max_row_distance_px
        limit = options.max_first_row_error_px * scale
        decided = on_rows and _row_error(*initial.matched, seed, options) < limit
    else:
        best = max(found.by_fundamental, found.by_other_rows)
        ratio = options.min_inlier_ratio
        # By three standard deviations of a binomial distribution.
        decided = found.on_rows < ratio * best - 3 * np.sqrt(best * ratio * abs(1 - ratio))
    if not decided:
        return None
    low, median, high = (value / scale for value in found.disparities)
    return replace(
        found, vertical_offset=found.vertical_offset / scale, disparities=(low, median, high)
    )


def _row_error(
    points0: np.ndarray, points1: np.ndarray, seed: int, options: RectificationOptions
) -> float:
    """Return by how much the rows of a pair that looks rectified are off at most of its matches.

    Not by the distance of each match from its row, which is as coarse as the matches, but by what
    all of them have in common: how that distance depends on the place (views that are turned, or
    bent by a lens) and on the disparity (a camera that moved up or down as well).
    """
    indices = grid_subsample(points0, options.grid_size_px, seed)
    first, second = points0[indices], points1[indices]
    off, disparity = second[:, 1] - first[:, 1], first[:, 0] - second[:, 0]
    near = np.abs(off) <= options.max_row_distance_px
    x, y = ((first[near] - first[near].mean(axis=0)) / np.ptp(first[near], axis=0).max()).T
    design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y, disparity[near]])
    predicted = design @ np.linalg.lstsq(design, off[near], rcond=None)[0]
    return float(np.quantile(np.abs(predicted), min(options.min_inlier_ratio, 1)))


def detect_rectification(
    points0: np.ndarray,
    points1: np.ndarray,
    size0: tuple[int, int],
    size1: tuple[int, int],
    offset_px: float = 0.0,
    seed: int = 0,
    options: RectificationOptions = RectificationOptions(),
) -> Rectification:
    """Decide from matches whether a pair is rectified.

    Args:
        points0, points1: (M, 2) matched positions in the left and the right image.
        size0, size1: (width, height) of the images.
        offset_px: what is added to a disparity before it gives the depth (calibration).
        seed: of the random samples.
        options: the thresholds.

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
    indices = grid_subsample(points0, options.grid_size_px, seed)
    first, second = points0[indices], points1[indices]
    limit = options.max_row_distance_px
    on_rows = np.abs(second[:, 1] - first[:, 1]) <= limit
    # Of a rectified pair Sampson's distance is that in rows over the root of 2.
    epipolar = estimate_geometry(
        first, second, seed=seed, options=GeometryOptions(inlier_threshold=limit / np.sqrt(2))
    )
    other_rows = _best_other_rows(first, second, size0, seed, options)
    disparity = (first - second)[on_rows, 0]
    spread = np.quantile(disparity, [0.05, 0.5, 0.95]) if len(disparity) else np.full(3, np.nan)
    vertical_offset = np.nan
    if epipolar.inliers.any():
        vertical_offset = float(np.median((second - first)[epipolar.inliers, 1]))
    counts = tuple(int(np.count_nonzero(part)) for part in (on_rows, epipolar.inliers, other_rows))
    # Rows are a line in every point; nothing was sampled, so this is on the safe side.
    alarms = log10_nfa(np.where(on_rows, 0, np.inf), "fundamental", limit, size1)
    if size0 != size1:
        reason = "the images differ in size"
    elif alarms > MAX_LOG10_NFA:
        reason = "hardly any match is on the same row in both images"
    else:
        reason = _reason(counts, vertical_offset, spread, options)
    if not reason and is_static(disparity, options.static):
        reason = "nothing moves between the images"
    if not reason and spread[2] - spread[0] < options.min_planar_spread_px:
        plane = estimate_geometry(
            first,
            second,
            "homography",
            seed=seed,
            options=GeometryOptions(inlier_threshold=options.max_transfer_error_px),
        )
        if is_planar(first, second, plane, epipolar, options.min_planar_ratio, seed):
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
    options: RectificationOptions,
) -> str:
    """Return why rows are not the geometry of the pair; empty when they may be."""
    on_rows, by_fundamental, by_other_rows = counts
    best = max(by_fundamental, by_other_rows)
    if on_rows < options.min_inlier_ratio * best:
        return (
            f"only {on_rows:,} of {best:,} matches that agree are on the same row in both images "
            f"(median offset {vertical_offset:+.1f} px)"
        )
    if spread[2] - spread[0] < options.min_disparity_spread_px:
        return f"all matches on rows have about the same disparity ({spread[1]:.3g} px)"
    return ""


def _best_other_rows(
    points0: np.ndarray,
    points1: np.ndarray,
    size: tuple[int, int],
    seed: int,
    options: RectificationOptions,
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
        agree: np.ndarray = np.abs(planes @ design.T - shift) <= options.max_row_distance_px
        return agree

    samples = np.random.default_rng(seed).integers(0, len(points0), (options.iterations, 3))
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
