"""Why two images give no depth, in one sentence and before any cloud is made.

Each check raises `NoDepthError` when its reason holds, and is silent on good pairs. They run
in this order: `check_images`, `check_matches`, and with a pose those of `calibration_checks`; for
rectified pairs `check_images`, then those of `rectified_checks`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .._shared.errors import NoDepthError
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from ..features.selection import grid_subsample
from ..geometry import (
    Geometry,
    GeometryOptions,
    epipolar_errors,
    estimate_geometry,
    transfer_errors,
)
from ..geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from ..geometry.camera import Calibration
from ..geometry.model_selection import ModelSelectionOptions, measure_parallax


@suggest_keywords
@dataclass(frozen=True)
class CopyOptions:
    """When two images are the same picture, perhaps saved again.

    Attributes:
        max_mean_difference_levels: grey levels by which copies differ in the mean.
        max_difference_levels: grey levels by which they differ nearly everywhere.
        max_difference_to_gradient: the same, as a multiple of what the picture differs from itself
            shifted by a pixel: dark views differ by few levels.
        quantile: the fraction of the pixels that is nearly everywhere.

    Raises:
        OptionError: a value is out of its range.
    """

    max_mean_difference_levels: float = 0.5
    max_difference_levels: float = 8.0
    max_difference_to_gradient: float = 0.5
    quantile: float = 0.999

    def __post_init__(self) -> None:
        levels = "max_mean_difference_levels", "max_difference_levels"
        check_ranges(
            self, not_negative=(*levels, "max_difference_to_gradient"), fractions=("quantile",)
        )


@suggest_keywords
@dataclass(frozen=True)
class StaticOptions:
    """When matches show that both images have the same view.

    Attributes:
        max_median_motion_px: the median match moves less.
        max_motion_px: nearly all matches move less.
        quantile: the fraction of the matches that is nearly all.

    Raises:
        OptionError: a value is out of its range.
    """

    max_median_motion_px: float = 0.5
    max_motion_px: float = 3.0
    quantile: float = 0.9

    def __post_init__(self) -> None:
        limits = "max_median_motion_px", "max_motion_px"
        check_ranges(self, not_negative=limits, fractions=("quantile",))


@suggest_keywords
@dataclass(frozen=True)
class ForegroundOptions:
    """When a scene that is mostly a plane has something in front of it.

    On planes wrong matches are this far off, and fewer of them lie on their epipolar lines: up to
    0.65 of them on sixteen pairs of Oxford.

    Attributes:
        min_distance_px: from the plane's homography, for a match to be clearly off it.
        min_fraction: of the matches that the fundamental matrix explains, clearly off the plane.
        min_epipolar_fraction: of the matches clearly off the plane, explained by the fundamental
            matrix.

    Raises:
        OptionError: a value is out of its range.
    """

    min_distance_px: float = 6.0
    min_fraction: float = 0.05
    min_epipolar_fraction: float = 0.8

    def __post_init__(self) -> None:
        shares = "min_fraction", "min_epipolar_fraction"
        check_ranges(self, not_negative=("min_distance_px",), fractions=shares)


@suggest_keywords
@dataclass(frozen=True)
class CheckOptions:
    """Thresholds of the checks.

    Attributes:
        copy: when both images are one picture.
        static: when nothing moves.
        foreground: when a plane is not all there is.
        grid_size_px: cells of the first image of this size give one match each: matches side by
            side are no independent evidence.
        min_matches: matches, one per cell, below which nothing is tried.
        max_epipolar_distance_px: within which a match agrees with a fundamental matrix (Sampson).
        max_transfer_error_px: within which a match agrees with a homography.
        min_planar_ratio: matches of the homography per match of the fundamental matrix, below
            which the scene is no plane.
        min_pose_ratio: matches of the essential matrix per match of the fundamental matrix: with
            a correct calibration the first explains as much.
        min_in_front_fraction: of the inliers of a pose, in front of both cameras.
        focal_factors: other focal lengths that are tried, in units of the given one.
        max_focal_error_ratio: of the median error of another focal length to that of the given one,
            which is refused below it: a focal length that is off by a fifth passes.
        good_error_px: median error at which no other focal length is tried.

    Raises:
        OptionError: a value is out of its range.
    """

    copy: CopyOptions = field(default_factory=CopyOptions)
    static: StaticOptions = field(default_factory=StaticOptions)
    foreground: ForegroundOptions = field(default_factory=ForegroundOptions)
    grid_size_px: int = 16
    min_matches: int = 30
    max_epipolar_distance_px: float = 1.5
    max_transfer_error_px: float = 2.0
    min_planar_ratio: float = 0.75
    min_pose_ratio: float = 0.75
    min_in_front_fraction: float = 0.75
    focal_factors: tuple[float, ...] = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0)
    max_focal_error_ratio: float = 0.5
    good_error_px: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("grid_size_px", "max_epipolar_distance_px", "max_transfer_error_px"),
                "focal_factors",
            ),
            not_negative=(
                "min_matches",
                "min_planar_ratio",
                "min_pose_ratio",
                "max_focal_error_ratio",
                "good_error_px",
            ),
            fractions=("min_in_front_fraction",),
        )


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the matches of a good pair have shown, for the checks that follow.

    Attributes:
        indices: (K,) of the matches that were used, one per cell.
        fundamental: (3, 3) that explains them best.
        explained: (K,) bool, which of them it explains.
        by_homography: fraction of them that one homography explains.
        log10_nfa: decimal logarithm of the fundamental matrix's number of false alarms.
    """

    indices: np.ndarray
    fundamental: np.ndarray
    explained: np.ndarray
    by_homography: float
    log10_nfa: float


def check_images(
    gray0: np.ndarray, gray1: np.ndarray, options: CopyOptions = CopyOptions()
) -> None:
    """Refuse two copies of one picture, also when one was saved again without visible loss.

    Copies that lost more show the same view: `check_matches` and `check_disparities` refuse them.

    Raises:
        NoDepthError: they are the same.

    Example:
        >>> check_images(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8))
        Traceback (most recent call last):
        ...
        deepdetect.NoDepthError: both images are the same picture: depth needs two \
photographs from two places
    """
    if gray0.shape == gray1.shape and _is_copy(gray0, gray1, options):
        raise NoDepthError(
            "both images are the same picture: depth needs two photographs from two places"
        )


def check_matches(
    points0: np.ndarray,
    points1: np.ndarray,
    size1: tuple[int, int],
    calibration: Calibration | None = None,
    seed: int = 0,
    options: CheckOptions = CheckOptions(),
) -> Evidence:
    """Refuse matches that show no overlap, no motion, or no depth.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        size1: (width, height) of the second image.
        calibration: distinguishes a rotating camera from a plane, where it is known.
        seed: of the random samples.
        options: the thresholds.

    Returns:
        What the pose is compared with.

    Raises:
        NoDepthError: too few matches agree with one geometry; nothing moves; or one
            homography explains them all.
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    indices = grid_subsample(points0, options.grid_size_px, seed)
    first, second = points0[indices], points1[indices]
    thresholds = {
        "fundamental": options.max_epipolar_distance_px,
        "homography": options.max_transfer_error_px,
    }
    epipolar, plane = (
        estimate_geometry(
            first, second, model, seed=seed, options=GeometryOptions(inlier_threshold=threshold)
        )
        for model, threshold in thresholds.items()
    )
    if len(indices) < options.min_matches or epipolar.matrix is None:
        raise NoDepthError(_no_overlap(len(points0)))
    off_plane = _plane_errors(first, second, plane.matrix)
    alarms = [
        log10_nfa(errors, model, thresholds[model], size1)
        for model, errors in (
            ("fundamental", epipolar_errors(first, second, epipolar.matrix)),
            ("homography", off_plane),
        )
    ]
    if min(alarms) > MAX_LOG10_NFA:
        raise NoDepthError(_no_overlap(len(points0)))
    motion = np.linalg.norm(second - first, axis=1)[epipolar.inliers | plane.inliers]
    if is_static(motion, options.static):
        raise NoDepthError(
            "nothing moves between the images: they show the same view, depth needs two "
            "photographs from two places"
        )
    planar = is_planar(first, second, plane, epipolar, options.min_planar_ratio, seed)
    if planar and not has_foreground(off_plane, epipolar.inliers, options.foreground):
        explained = first[plane.inliers], second[plane.inliers]
        raise NoDepthError(_no_depth(*explained, calibration, options))
    return Evidence(
        indices=indices,
        fundamental=epipolar.matrix,
        explained=epipolar.inliers,
        by_homography=float(plane.inliers.mean()),
        log10_nfa=float(alarms[0]),
    )


def is_planar(
    points0: np.ndarray,
    points1: np.ndarray,
    plane: Geometry,
    epipolar: Geometry,
    min_ratio: float = CheckOptions.min_planar_ratio,
    seed: int = 0,
    max_parallax: float = ModelSelectionOptions.min_fraction_of_plane,
) -> bool:
    """Return whether a homography explains all that can be explained, though many may be wrong.

    Args:
        points0, points1: (M, 2) matches, some of them wrong.
        plane, epipolar: the homography and the fundamental matrix that were estimated from them.
        min_ratio: matches of the homography per match of the fundamental matrix, of a plane.
        seed: of the search for an epipole among the others.
        max_parallax: as many of the others may agree on an epipole, relative to the matches on the
            plane: a repeated pattern, or a thing that moved, gives a few.

    Example:
        >>> points = np.random.default_rng(0).uniform(0, 500, (300, 2))
        >>> models = [
        ...     estimate_geometry(points, points + 5, model)
        ...     for model in ("homography", "fundamental")
        ... ]
        >>> is_planar(points, points + 5, *models)
        True
    """
    explained = np.count_nonzero(plane.inliers) >= min_ratio * np.count_nonzero(epipolar.inliers)
    if plane.matrix is None or not explained:
        return False
    parallax = measure_parallax(points0, points1, plane.matrix, seed=seed)
    # Not `is_depth`, which needs a share of all matches off the plane, wrong ones among them.
    return not parallax.is_seen() or parallax.agreeing < max_parallax * parallax.on_plane


def has_foreground(
    off_plane_px: np.ndarray,
    by_fundamental: np.ndarray,
    options: ForegroundOptions = ForegroundOptions(),
) -> bool:
    """Return whether something stands in front of the plane, small as it may be."""
    clear = off_plane_px > options.min_distance_px
    foreground = np.count_nonzero(clear & by_fundamental)
    needed = max(
        options.min_epipolar_fraction * np.count_nonzero(clear),
        options.min_fraction * np.count_nonzero(by_fundamental),
    )
    return bool(foreground > 0 and foreground >= needed)


def is_static(motion_px: np.ndarray, options: StaticOptions = StaticOptions()) -> bool:
    """Return whether matches that move this far show the same view in both images.

    Example:
        >>> is_static(np.array([0.1, 0.0, 0.3])), is_static(np.array([0.1, 0.2, 7.0]))
        (True, False)
    """
    motion = np.abs(motion_px)
    return bool(
        np.median(motion) < options.max_median_motion_px
        and np.quantile(motion, options.quantile) < options.max_motion_px
    )


def _is_copy(gray0: np.ndarray, gray1: np.ndarray, options: CopyOptions) -> bool:
    difference = cv2.absdiff(gray0, gray1)
    if difference.mean() >= options.max_mean_difference_levels:
        return False
    largest = np.quantile(difference, options.quantile)
    gradient = np.quantile(cv2.absdiff(gray0[:, 1:], gray0[:, :-1]), options.quantile)
    limit = min(options.max_difference_levels, options.max_difference_to_gradient * gradient)
    return bool(largest <= limit)


def _plane_errors(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray | None
) -> np.ndarray:
    if homography is None:
        return np.full(len(points0), np.inf)
    return transfer_errors(points0, points1, homography)


def _no_overlap(matches: int) -> str:
    if not matches:
        return (
            "there are no matches: the photographs do not overlap, or do not show the same scene, "
            "or no pixel of one is above the threshold (lower `threshold`, or give `density`)"
        )
    return (
        f"too few of the {matches:,} matches agree with one geometry: the photographs do not "
        "overlap, or do not show the same scene"
    )


def _no_depth(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration | None,
    options: CheckOptions,
) -> str:
    if calibration is not None and is_pure_rotation(
        points0, points1, calibration, options.max_epipolar_distance_px
    ):
        return (
            "a rotation of the camera explains all the matches and there is no depth: move it "
            "sideways between the photographs"
        )
    return (
        "one homography explains all the matches: the photographs show a plane, or the camera "
        "only rotated, and there is no depth"
    )


def is_pure_rotation(
    points0: np.ndarray, points1: np.ndarray, calibration: Calibration, max_error_px: float
) -> bool:
    """Return whether one rotation maps the rays of matches onto each other (Kabsch's method)."""
    rays0, rays1 = (
        rays / np.linalg.norm(rays, axis=1, keepdims=True)
        for rays in (calibration.camera0.rays(points0), calibration.camera1.rays(points1))
    )
    u, _, vt = np.linalg.svd(rays1.T @ rays0)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    seen = calibration.camera1.project(rays0 @ rotation.T)
    return bool(np.median(np.linalg.norm(seen - points1, axis=1)) < max_error_px)
