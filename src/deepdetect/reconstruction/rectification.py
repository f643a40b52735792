"""Recognition of rectified pairs, and checks that such a pair is right and has depth.

Matches of a rectified pair lie on the same row of both images. This model without parameters must
explain about as many matches as the best models with parameters do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .._shared.errors import NoDepthError, ReconstructionError
from .._shared.opencv import cv2
from ..features.selection import grid_subsample
from ..geometry.camera import Calibration
from ..geometry.estimation import MAX_LOG10_NFA, log10_nfa
from ..geometry.two_view import SCENE_THRESHOLDS_PX, fit_model, is_planar, is_static
from ..matching.guided import TentativeMatches, find_tentative_matches

MAX_ROW_DISTANCE_PX = 1.0
"""Matches of a rectified pair may be off their row by this much. Chosen by hand."""

MIN_INLIER_RATIO = 0.9
"""Rows must explain this share of the matches that the best other model does. Chosen by hand."""

MIN_DISPARITY_SPREAD_PX = 2.0
"""Disparities of a pair with depth must spread by this much from the 5th to the 95th percentile:
matches at whole pixels always spread by 1."""

MIN_PLANAR_SPREAD_PX = 8.0
"""If one homography explains a pair, its disparities must spread by this much. Disparities of a
slanted plane do, those of a camera that only rotated a little spread less."""

GRID_SIZE_PX = 8
"""Each cell of the left image of this size gives one match. Chosen by hand."""

ITERATIONS = 500
"""RANSAC draws this number of samples of three matches for `_best_other_rows`. Chosen by hand."""

COARSE_SIDE_PX, COARSE_KEYPOINTS = 480, 1000
"""The first pass matches copies with this longer side and number of keypoints. Chosen by hand."""

MIN_COARSE_INLIERS = 50
"""The coarse pass decides only if a fundamental matrix explains this number of its matches. Chosen
by hand."""

MAX_COARSE_ROW_ERROR_PX = 0.6
"""The coarse pass accepts a pair only if its rows are off by less at `MIN_INLIER_RATIO` of the
matches, in pixels of the full images: many matches together are more accurate than each alone."""

MAX_FOCAL_DIFFERENCE_FRACTION = 0.01
"""Focal lengths of rectified views may differ by this fraction, so that values given to three
digits pass. A row 200 px from the middle is then off by 2 px."""

MAX_CY_DIFFERENCE_PX = 2.0
"""cy of rectified views may differ by this, twice the distance that a match may be off its row."""

MIN_DEPTH_SPREAD_PX = 0.5
"""Disparities of a scene with depth spread by more, from the 5th to the 95th percentile. Chosen by
hand."""

MIN_DISPARITY_PX = -1.0
"""A point is behind the cameras if its disparity plus the calibration's offset is below this. One
pixel is allowed for noise."""

MAX_BEHIND_FRACTION = 0.25
"""A calibration is wrong if a larger fraction of points lies behind the cameras. Chosen by hand."""

MAX_ROTATION_ERROR_PX, MIN_ROTATION_FRACTION = 0.3, 0.5
"""A rotation explains a disparity up to the first error. It explains a pair if it explains more
than the second share of the disparities, which was 0.64 or more for four views rotated by half a
degree to two."""

MAX_RATIO_TO_PLANE = 0.5
"""The median error of the rotation, divided by that of the best plane in disparity, must be below
this. The ratio was up to 0.33 for rotated views, and at least 5.3 for slanted walls."""

MAX_OFF_ROW_PX = 1.0
"""Matches are found on rows. A rotation may move them off their rows by this median distance."""

ROBUST_ITERATIONS = 12

ROTATION_GRID_SIZE_PX, MIN_ROTATION_MATCHES, MAX_ROTATION_SAMPLES = 16, 30, 50_000
"""A rotation is fitted to one disparity per cell of the first size, if there are at least the
second number of them. If there are more disparities than the third number, a random sample is used.
Chosen by hand."""


@dataclass(frozen=True)
class Rectification:
    """Whether a pair is rectified, and the figures behind that decision.

    Attributes:
        rectified: whether the pair is rectified.
        reason: why it is not rectified, or empty.
        swapped: the pair is rectified, but left and right are exchanged.
        on_rows: number of `matches` whose rows differ by at most one.
        by_fundamental: number of matches that a fundamental matrix explains as closely.
        by_other_rows: number of matches on rows that are shifted, tilted and scaled.
        matches: number of matches that were used, one per cell.
        vertical_offset: median of y in the second minus y in the first image, in pixels, of the
            matches that the fundamental matrix explains.
        disparities: 5th percentile, median and 95th percentile in pixels on rows, or NaN.
    """

    rectified: bool
    reason: str
    swapped: bool
    on_rows: int
    by_fundamental: int
    by_other_rows: int
    matches: int
    vertical_offset: float
    disparities: tuple[float, float, float]


def find_rectification(
    gray0: np.ndarray, gray1: np.ndarray, offset_px: float = 0.0, seed: int = 0
) -> tuple[Rectification, TentativeMatches | None]:
    """Decide whether two images (H, W) are rectified, from small copies if these are decisive.

    `offset_px` is added to a disparity before it gives a depth. Also returns the tentative matches
    of larger copies, if they were needed.
    """
    size = gray0.shape[::-1]
    if gray0.shape != gray1.shape:
        nowhere = np.empty((0, 2))
        nothing = detect_rectification(nowhere, nowhere, size, offset_px, seed)
        return replace(nothing, reason="the images differ in size"), None
    if max(size) > COARSE_SIDE_PX:
        found = _coarse_pass(gray0, gray1, offset_px, seed)
        if found is not None:
            return found, None
    tentative = find_tentative_matches(gray0, gray1)
    points = tentative.points0, tentative.points1
    return detect_rectification(*points, size, offset_px, seed), tentative


def _coarse_pass(
    gray0: np.ndarray, gray1: np.ndarray, offset_px: float, seed: int
) -> Rectification | None:
    """Decide from small copies of two images of one size; None if these are not decisive."""
    coarse = find_tentative_matches(
        gray0, gray1, max_side_px=COARSE_SIDE_PX, max_keypoints=COARSE_KEYPOINTS
    )
    scale, size = coarse.scales[0], coarse.views[0].shape[::-1]
    # The thresholds are in pixels of the copies, so they leave a margin at full size.
    found = detect_rectification(*coarse.matched, size, offset_px * scale, seed)
    if found.by_fundamental < MIN_COARSE_INLIERS:
        return None
    if found.rectified:
        on_rows = abs(found.disparities[1] + offset_px * scale) > MAX_ROW_DISTANCE_PX
        limit = MAX_COARSE_ROW_ERROR_PX * scale
        decided = on_rows and _row_error(*coarse.matched, seed) < limit
    else:
        best = max(found.by_fundamental, found.by_other_rows)
        # The margin is three standard deviations of a binomial distribution.
        deviation = np.sqrt(best * MIN_INLIER_RATIO * (1 - MIN_INLIER_RATIO))
        decided = found.on_rows < MIN_INLIER_RATIO * best - 3 * deviation
    if not decided:
        return None
    low, median, high = (value / scale for value in found.disparities)
    return replace(
        found, vertical_offset=found.vertical_offset / scale, disparities=(low, median, high)
    )


def _row_error(points0: np.ndarray, points1: np.ndarray, seed: int) -> float:
    """Return the error in pixels of the rows of a pair that looks rectified, as a high quantile.

    A single match is too inaccurate for this. So a function of position (for rotated views and lens
    distortion) and disparity (for a camera that also moved up or down) is fitted to the distances
    of all matches from their rows.
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
    size: tuple[int, int],
    offset_px: float = 0.0,
    seed: int = 0,
) -> Rectification:
    """Decide from matches (M, 2) whether a pair of images of one (width, height) is rectified."""
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    indices = grid_subsample(points0, GRID_SIZE_PX, seed)
    first, second = points0[indices], points1[indices]
    limit = MAX_ROW_DISTANCE_PX
    on_rows = np.abs(second[:, 1] - first[:, 1]) <= limit
    # For a rectified pair, Sampson's distance is the difference of the rows over the root of 2.
    epipolar = fit_model(first, second, "fundamental", size, limit / np.sqrt(2), seed)
    other_rows = _best_other_rows(first, second, size, seed)
    disparity = (first - second)[on_rows, 0]
    spread = np.quantile(disparity, [0.05, 0.5, 0.95]) if len(disparity) else np.full(3, np.nan)
    vertical_offset = np.nan
    if epipolar.inliers.any():
        vertical_offset = float(np.median((second - first)[epipolar.inliers, 1]))
    on_rows_count, by_fundamental, by_other_rows = (
        int(np.count_nonzero(part)) for part in (on_rows, epipolar.inliers, other_rows)
    )
    best = max(by_fundamental, by_other_rows)
    reason = ""
    # The test for fundamental matrices allows for sampling; rows are not sampled, so it is strict.
    if log10_nfa(on_rows, "fundamental", limit, size) > MAX_LOG10_NFA:
        reason = "hardly any match is on the same row in both images"
    elif on_rows_count < MIN_INLIER_RATIO * best:
        reason = (
            f"only {on_rows_count:,} of {best:,} consistent matches are on the same row in both "
            "images"
        )
    elif spread[2] - spread[0] < MIN_DISPARITY_SPREAD_PX:
        reason = f"all matches on rows have about the same disparity ({spread[1]:.3g} px)"
    elif is_static(disparity):
        reason = "nothing moves between the images"
    elif spread[2] - spread[0] < MIN_PLANAR_SPREAD_PX:
        threshold_px = SCENE_THRESHOLDS_PX["homography"]
        plane = fit_model(first, second, "homography", size, threshold_px, seed)
        if is_planar(first, second, plane, epipolar, seed):
            reason = "one homography explains all the matches: they all move nearly alike"
    return Rectification(
        rectified=not reason,
        reason=reason,
        swapped=bool(not reason and spread[1] + offset_px < 0),
        on_rows=on_rows_count,
        by_fundamental=by_fundamental,
        by_other_rows=by_other_rows,
        matches=len(indices),
        vertical_offset=vertical_offset,
        disparities=(float(spread[0]), float(spread[1]), float(spread[2])),
    )


def _best_other_rows(
    points0: np.ndarray, points1: np.ndarray, size: tuple[int, int], seed: int
) -> np.ndarray:
    """Fit the vertical shift as a plane over the image by RANSAC; return its inliers, (M,) bool.

    A sample has three matches, not seven as for a fundamental matrix: it tolerates more outliers.
    """
    shift = points1[:, 1] - points0[:, 1]
    best = np.zeros(len(points0), bool)
    if len(points0) < 3:
        return best
    design = np.column_stack([points0 / max(size), np.ones(len(points0))])
    samples = np.random.default_rng(seed).integers(0, len(points0), (ITERATIONS, 3))
    samples = samples[np.abs(np.linalg.det(design[samples])) >= 1e-4]
    planes = np.linalg.solve(design[samples], shift[samples][..., None])[..., 0]
    agreeing = np.abs(planes @ design.T - shift) <= MAX_ROW_DISTANCE_PX
    if agreeing.any():
        best = agreeing[np.argmax(np.count_nonzero(agreeing, axis=1))]
    if np.count_nonzero(best) >= 3:
        plane = np.linalg.lstsq(design[best], shift[best], rcond=None)[0]
        refined = np.abs(design @ plane - shift) <= MAX_ROW_DISTANCE_PX
        if np.count_nonzero(refined) > np.count_nonzero(best):
            best = refined
    return best


def check_cameras(calibration: Calibration) -> None:
    """Raise a ReconstructionError if focal lengths or cy of both views differ."""
    camera0, camera1 = calibration.camera0, calibration.camera1
    pairs = [
        ("the focal lengths", focal0, focal1, MAX_FOCAL_DIFFERENCE_FRACTION * focal0)
        for focal0, focal1 in zip(camera0.focal_px, camera1.focal_px, strict=True)
    ]
    pairs.append(("cy", camera0.centre[1], camera1.centre[1], MAX_CY_DIFFERENCE_PX))
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

    A rotation by an angle a about the vertical moves pixels along their rows by f a (1 + x^2) to
    first order, where x is the slope of the ray: like a wall, but curved. The rotation is not
    noticed if the focal length is far off, the camera also tilted, or the curvature is below the
    noise.
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
    """Raise a ReconstructionError if many points of a rectified pair are behind the cameras."""
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
    """Fit a rotation to disparities robustly; return the residuals (N,) in pixels.

    The axes are the vertical and the optical axis: a tilt hardly changes disparities. Residuals are
    infinite if the rotation moves the matches off their rows.
    """
    camera, rays = calibration.camera1, calibration.camera0.rays(pixels)
    matched = pixels - np.column_stack([disparity, np.zeros(len(disparity))])
    wanted = camera.rays(matched)[:, 0]
    # The median rotation about the vertical is close enough as a start.
    angle = np.median(np.arctan(wanted) - np.arctan(rays[:, 0]))
    rotation = cv2.Rodrigues(np.array([0, angle, 0]))[0]
    for _ in range(ROBUST_ITERATIONS):
        rotated = rays @ rotation.T
        x, y = (rotated[:, :2] / rotated[:, 2:]).T
        slopes = np.column_stack([1 + x * x, -y])
        angles = _robust_step(slopes, wanted - x, camera.focal_px[0])
        rotation = cv2.Rodrigues(np.array([0, *angles]))[0] @ rotation
    across, down = np.abs(camera.project(rays @ rotation.T) - matched).T
    return across if np.median(down) <= MAX_OFF_ROW_PX else np.full(len(pixels), np.inf)


def _plane_errors(pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Fit a plane to disparities over x and y robustly; return the residuals (N,) in pixels."""
    design = np.column_stack([pixels / max(pixels.max(), 1), np.ones(len(pixels))])
    plane = np.array([0, 0, np.median(disparity)])
    for _ in range(ROBUST_ITERATIONS):
        plane = plane + _robust_step(design, disparity - design @ plane, 1.0)
    return np.abs(disparity - design @ plane)


def _robust_step(design: np.ndarray, error: np.ndarray, pixel: float) -> np.ndarray:
    weight = 1 / np.sqrt(np.maximum(np.abs(error) * pixel, 0.02))
    return np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]
