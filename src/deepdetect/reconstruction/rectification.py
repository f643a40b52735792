"""Recognise rectified pairs, and check that the calibration fits them and that they show depth.

In a rectified pair, both points of a match lie on the same image row. A pair is taken as rectified
if about as many of its matches do so as fit a fundamental matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .._shared.errors import NoDepthError, ReconstructionError
from .._shared.opencv import cv2
from ..features.selection import grid_subsample
from ..geometry.camera import Calibration
from ..geometry.estimation import MAX_LOG10_NFA, log10_nfa
from ..geometry.transforms import scaled_points
from ..geometry.two_view import SCENE_THRESHOLDS_PX, fit_model, is_static
from ..matching.guided import ImagePair, Sources

MAX_ROW_DISTANCE_PX = 1.0
"""The rows of a match may differ by at most this in a rectified pair, and the values of cy (the row
of the principal point) of both views by at most twice this. Chosen by hand."""

MIN_INLIER_RATIO = 0.9
"""A pair is rectified only if its same-row matches number at least this fraction of a fundamental
matrix's inliers. If a homography's inliers do so, the pair shows a plane. Chosen by hand."""

MIN_DISPARITY_SPREAD_PX = 2.0
"""A pair is rectified only if its disparities spread by at least this from the 5th to the 95th
percentile. Rounding to whole pixels alone can spread equal disparities by 1 px."""

MIN_PLANAR_SPREAD_PX = 8.0
"""If one homography fits nearly all matches, a pair is rectified only if its disparities spread by
at least this (5th to 95th percentile), as on a slanted plane. Small rotations spread them less."""

GRID_SIZE_PX = 8
"""A pair is tested with one match per square of this side in the left image. Chosen by hand."""

MIN_COARSE_INLIERS = 50
"""Small copies can show a pair as not rectified if this many matches fit a fundamental matrix."""

MAX_FOCAL_DIFFERENCE_FRACTION = 0.01
"""The focal lengths of rectified views may differ by at most this fraction, so that values rounded
to three digits pass. If they differ by this much, a row 200 px from the middle is off by 2 px."""

MIN_DEPTH_SPREAD_PX = 0.5
"""A pair shows depth only if its disparities spread by at least this from the 5th to the 95th
percentile. Chosen by hand."""

MIN_DISPARITY_PX = -1.0
"""A point lies behind the cameras if its disparity plus the disparity offset of the calibration is
below this. One pixel is allowed for noise."""

MAX_BEHIND_FRACTION = 0.25
"""Maximum fraction of points behind the cameras for a correct calibration. Chosen by hand."""

MAX_ROTATION_ERROR_PX, MIN_ROTATION_FRACTION = 0.3, 0.5
"""A disparity fits a rotation if its error is below MAX_ROTATION_ERROR_PX. A pair is rejected as a
pure rotation only if more than MIN_ROTATION_FRACTION of its disparities fit the best rotation: in
four Middlebury views, rotated by 0.5 to 2 degrees, at least 0.64 of them did."""

MAX_RATIO_TO_PLANE = 0.5
"""A pair is rejected as a pure rotation only if the median error of the disparities under the best
rotation, divided by that under the best plane, is below this. The ratio was up to 0.33 for four
rotated Middlebury views, and at least 5.3 for four images drawn on slanted walls."""

ROBUST_ITERATIONS = 12

ROTATION_GRID_SIZE_PX, MIN_ROTATION_MATCHES, MAX_ROTATION_SAMPLES = 16, 30, 50_000
"""A rotation is fitted to one disparity per image square of side ROTATION_GRID_SIZE_PX, and only if
there are at least MIN_ROTATION_MATCHES of them. They are taken from at most MAX_ROTATION_SAMPLES
random disparities. Chosen by hand."""


@dataclass(frozen=True)
class Rectification:
    """Whether a pair is rectified, and the numbers on which that decision is based.

    Attributes:
        rectified: whether the pair is rectified.
        reason: why the pair is not rectified; empty if it is.
        swapped: whether the pair is rectified, but left and right are exchanged.
        on_rows: number of `matches` whose rows in the two images differ by at most one pixel.
        by_fundamental: number of `matches` that fit a fundamental matrix with the same tolerance.
        matches: number of matches that were tested, one per square of 8 px in the left image.
        disparities: 5th percentile, median and 95th percentile of the disparities, in pixels, of
            the matches on the same row; NaN if there are none.
    """

    rectified: bool
    reason: str
    swapped: bool
    on_rows: int
    by_fundamental: int
    matches: int
    disparities: tuple[float, float, float]


def find_rectification(
    gray0: np.ndarray, gray1: np.ndarray, offset_px: float = 0.0, seed: int = 0
) -> Rectification:
    """Decide whether two (H, W) images are a rectified pair, from small copies if these suffice.

    `offset_px` is the disparity offset of the calibration.
    """
    size = gray0.shape[::-1]
    if gray0.shape != gray1.shape:
        nowhere = np.empty((0, 2))
        nothing = detect_rectification(nowhere, nowhere, size, offset_px, seed)
        return replace(nothing, reason="the images differ in size")
    sources = Sources(ImagePair((gray0, gray1)))
    found = _coarse_pass(sources, size, offset_px, seed)
    if found is not None:
        return found
    matches = sources.dense
    return detect_rectification(matches.points0, matches.points1, size, offset_px, seed)


def _coarse_pass(
    sources: Sources, size: tuple[int, int], offset_px: float, seed: int
) -> Rectification | None:
    """Recognise in small copies that a pair is not rectified; None if they leave this open."""
    coarse = sources.learned
    scale = 1 / coarse.pixel
    if scale == 1:
        return None
    small = round(size[0] * scale), round(size[1] * scale)
    matched = scaled_points(coarse.points0, scale), scaled_points(coarse.points1, scale)
    # One pixel in the copies is more at full size, so more matches count as on the same row.
    found = detect_rectification(*matched, small, offset_px * scale, seed)
    few = found.by_fundamental < MIN_COARSE_INLIERS
    if few or found.rectified or 2 * found.on_rows >= found.by_fundamental:
        return None
    low, median, high = (value / scale for value in found.disparities)
    return replace(found, disparities=(low, median, high))


def detect_rectification(
    points0: np.ndarray,
    points1: np.ndarray,
    size: tuple[int, int],
    offset_px: float = 0.0,
    seed: int = 0,
) -> Rectification:
    """Decide from (M, 2) matches whether a pair of images of one (width, height) is rectified."""
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    indices = grid_subsample(points0, GRID_SIZE_PX, seed)
    first, second = points0[indices], points1[indices]
    limit = MAX_ROW_DISTANCE_PX
    on_rows = np.abs(second[:, 1] - first[:, 1]) <= limit
    # In a rectified pair, the Sampson distance is the difference of the rows divided by sqrt(2).
    epipolar = fit_model(first, second, "fundamental", size, limit / np.sqrt(2), seed)
    disparity = (first - second)[on_rows, 0]
    spread = np.quantile(disparity, [0.05, 0.5, 0.95]) if len(disparity) else np.full(3, np.nan)
    on_rows_count, best = (int(np.count_nonzero(part)) for part in (on_rows, epipolar.inliers))
    reason = ""
    # "On the same row" has no fitted parameters, so a fundamental matrix's NFA is strict enough.
    if log10_nfa(on_rows, "fundamental", limit, size) > MAX_LOG10_NFA:
        reason = "hardly any match is on the same row in both images"
    elif on_rows_count < MIN_INLIER_RATIO * best:
        reason = (
            f"only {on_rows_count:,} of {best:,} consistent matches are on the same row in both "
            "images"
        )
    elif spread[2] - spread[0] < MIN_DISPARITY_SPREAD_PX:
        reason = f"matches on the same row all have about the same disparity ({spread[1]:.3g} px)"
    elif is_static(disparity):
        reason = "nothing moves between the images"
    elif spread[2] - spread[0] < MIN_PLANAR_SPREAD_PX:
        threshold_px = SCENE_THRESHOLDS_PX["homography"]
        plane = fit_model(first, second, "homography", size, threshold_px, seed)
        if np.count_nonzero(plane.inliers) >= MIN_INLIER_RATIO * best:
            reason = "one homography explains all the matches: they all move nearly alike"
    return Rectification(
        rectified=not reason,
        reason=reason,
        swapped=bool(not reason and spread[1] + offset_px < 0),
        on_rows=on_rows_count,
        by_fundamental=best,
        matches=len(indices),
        disparities=(float(spread[0]), float(spread[1]), float(spread[2])),
    )


def check_cameras(calibration: Calibration) -> None:
    """Raise a ReconstructionError if the two views differ too much in focal length or cy."""
    camera0, camera1 = calibration.camera0, calibration.camera1
    pairs = [
        ("the focal lengths", focal0, focal1, MAX_FOCAL_DIFFERENCE_FRACTION * focal0)
        for focal0, focal1 in zip(camera0.focal_px, camera1.focal_px, strict=True)
    ]
    pairs.append(("cy", camera0.centre[1], camera1.centre[1], 2 * MAX_ROW_DISTANCE_PX))
    for name, value0, value1, most in pairs:
        if abs(value1 - value0) > most:
            raise ReconstructionError(
                f"{name} of the left and the right view are {value0:g} and {value1:g} px, but must "
                f"be equal for a rectified pair: fix the calibration ({calibration.source}), or "
                "pass `rectified=False`"
            )


def check_disparities(disparity: np.ndarray) -> None:
    """Raise a NoDepthError if all disparities of a rectified pair are nearly the same."""
    if is_static(disparity):
        raise NoDepthError("all disparities are 0: take the images from two different places")
    low, middle, high = np.quantile(disparity, [0.05, 0.5, 0.95])
    if high - low < MIN_DEPTH_SPREAD_PX:
        raise NoDepthError(
            f"all disparities are {middle:.3g} px, so there is no depth: one image is the other "
            "shifted sideways, or both show one plane"
        )


def check_pure_rotation(
    pixels: np.ndarray, disparity: np.ndarray, calibration: Calibration
) -> None:
    """Raise a NoDepthError if a rotation explains the disparities far better than a plane does.

    To first order, a rotation about the vertical by an angle a moves pixels by f a (1 + x^2) along
    their rows, where f is the focal length and x the horizontal slope of the ray. Disparities of a
    plane lack this curvature. The rotation is not noticed if f is far off, if the camera was also
    tilted, or if the noise hides the curvature.
    """
    chosen = np.arange(len(pixels))
    if len(chosen) > MAX_ROTATION_SAMPLES:
        chosen = np.random.default_rng(0).choice(len(chosen), MAX_ROTATION_SAMPLES, replace=False)
    chosen = chosen[grid_subsample(pixels[chosen], ROTATION_GRID_SIZE_PX)]
    if len(chosen) < MIN_ROTATION_MATCHES:
        return
    pixels, disparity = np.asarray(pixels, np.float64)[chosen], np.asarray(disparity)[chosen]
    by_rotation = _rotation_errors(pixels, disparity, calibration)
    by_plane = _plane_errors(pixels, disparity)
    better = np.median(by_rotation) < MAX_RATIO_TO_PLANE * np.median(by_plane)
    explained = np.mean(by_rotation < MAX_ROTATION_ERROR_PX)
    if better and explained > MIN_ROTATION_FRACTION:
        raise NoDepthError(
            "a rotation explains most disparities: move the camera sideways between the images"
        )


def check_depths(disparity: np.ndarray, calibration: Calibration) -> None:
    """Raise a ReconstructionError if many points of a rectified pair lie behind the cameras."""
    offset = calibration.disparity_offset_px
    behind = float(np.mean(disparity + offset < MIN_DISPARITY_PX))
    if behind > MAX_BEHIND_FRACTION:
        raise ReconstructionError(
            f"{behind:.0%} of the points would lie behind the cameras: left and right are "
            f"exchanged, or the disparity offset of {offset:g} px ({calibration.source}) is wrong"
        )


def _rotation_errors(
    pixels: np.ndarray, disparity: np.ndarray, calibration: Calibration
) -> np.ndarray:
    """Fit a rotation robustly to the disparities at (N, 2) pixels; return (N,) errors in pixels.

    Only rotations about the vertical and the optical axis are fitted, because a tilt about the
    horizontal axis hardly changes disparities. All errors are infinite if the rotation moves the
    matches off their rows.
    """
    camera, rays = calibration.camera1, calibration.camera0.rays(pixels)
    matched = pixels - np.column_stack([disparity, np.zeros(len(disparity))])
    wanted = camera.rays(matched)[:, 0]
    # Each match gives an angle about the vertical. The median angle is a good enough start.
    angle = np.median(np.arctan(wanted) - np.arctan(rays[:, 0]))
    rotation = cv2.Rodrigues(np.array([0, angle, 0]))[0]
    for _ in range(ROBUST_ITERATIONS):
        rotated = rays @ rotation.T
        x, y = (rotated[:, :2] / rotated[:, 2:]).T
        slopes = np.column_stack([1 + x * x, -y])
        angles = _robust_step(slopes, wanted - x, camera.focal_px[0])
        rotation = cv2.Rodrigues(np.array([0, *angles]))[0] @ rotation
    across, down = np.abs(camera.project(rays @ rotation.T) - matched).T
    return across if np.median(down) <= MAX_ROW_DISTANCE_PX else np.full(len(pixels), np.inf)


def _plane_errors(pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Fit a linear function of x and y robustly to disparities; return (N,) errors in pixels."""
    design = np.column_stack([pixels / max(pixels.max(), 1), np.ones(len(pixels))])
    plane = np.array([0, 0, np.median(disparity)])
    for _ in range(ROBUST_ITERATIONS):
        plane = plane + _robust_step(design, disparity - design @ plane, 1.0)
    return np.abs(disparity - design @ plane)


def _robust_step(design: np.ndarray, error: np.ndarray, pixel: float) -> np.ndarray:
    weight = 1 / np.sqrt(np.maximum(np.abs(error) * pixel, 0.02))
    return np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
