"""Why two images give no depth, in one sentence and before any cloud is made.

Each check raises an error when its reason holds, and is silent on good pairs. They run in this
order: `check_images`, `check_matches`, then `check_pose` and `check_focal`; for rectified pairs
`check_images`, `check_cameras`, and those that follow it below.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._shared.errors import NoDepthError, ReconstructionError
from .._shared.opencv import cv2
from ..features.selection import SelectionOptions, grid_subsample
from ..geometry.camera import Calibration, Camera
from ..geometry.relative_pose import RelativePose, estimate_relative_pose
from ..geometry.two_view import SCENE_THRESHOLDS_PX, Scene, classify_scene, is_static

MAX_MEAN_DIFFERENCE_LEVELS = 0.5
"""Grey levels by which copies of one image differ in the mean."""

MAX_DIFFERENCE_LEVELS, DIFFERENCE_QUANTILE = 8.0, 0.999
"""Grey levels by which they differ nearly everywhere: at this fraction of the pixels."""

MAX_DIFFERENCE_TO_GRADIENT = 0.5
"""The same, as a multiple of what the image differs from itself shifted by a pixel: dark views
differ by few levels."""

GRID_SIZE_PX = 16
"""Cells of the first image of this size give one match each: matches side by side are no
independent evidence."""

MIN_POSE_RATIO = 0.75
"""Matches of the essential matrix per match of the fundamental matrix: with a correct calibration
the first explains as much."""

MIN_IN_FRONT_FRACTION = 0.75
"""Of the inliers of a pose, in front of both cameras."""

FOCAL_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0)
"""Other focal lengths that are tried, in units of the given one."""

MAX_FOCAL_ERROR_RATIO = 0.5
"""Of the median error of another focal length to that of the given one, which is refused below it:
a focal length that is off by a fifth passes."""

GOOD_ERROR_PX = 0.1
"""Median error at which no other focal length is tried."""

MAX_EPIPOLAR_DISTANCE_PX = SCENE_THRESHOLDS_PX["fundamental"]

NO_DEPTH = {
    "static": "nothing moves between the images: they show the same view, depth needs two images "
    "from two places",
    "rotation": "a rotation of the camera explains all the matches and there is no depth: move it "
    "sideways between the images",
    "plane": "one homography explains all the matches: the images show a plane, or the camera only "
    "rotated, and there is no depth",
}
"""What is said of the kinds of `Scene` without depth."""


MAX_FOCAL_DIFFERENCE_FRACTION = 0.01
"""Of the focal lengths of both views. Rectified views have one; lengths given to three digits pass,
and at 0.01 a row is off by 2 px at the edge of 400."""

MAX_CY_DIFFERENCE_PX = 2.0
"""Of cy of both views: twice what a match may be off its row."""

MIN_UNIQUE_FRACTION = 0.1
"""Of the keypoints with a match on their row, where only unique matches count: unrelated images
gave up to 0.005, rectified pairs at least 0.35."""

MIN_MATCHED_FRACTION = 0.25
"""The same where all matches count: up to 0.16, and at least 0.64."""

MIN_DISPARITY_SPREAD_PX = 0.5
"""Between the 5th and 95th percentile, in a scene with depth."""

MIN_DISPARITY_PX = -1.0
"""With the offset; smaller ones put points behind the cameras."""

MAX_BEHIND_FRACTION = 0.25
"""Of the points, behind the cameras."""

# When disparities are those of a camera that only rotated. Walls are planes in disparity, a
# rotation bends them. Chosen on four views rotated by half a degree to two (fraction 0.64, ratio
# 0.33 at worst) and as many drawn on slanted walls before two cameras (ratio 5.3 at least);
# Motorcycle and seven scenes of Middlebury ask for rotations that would leave the rows.

MAX_ROTATION_ERROR_PX, MIN_ROTATION_FRACTION = 0.3, 0.5
"""Within which the rotation explains a disparity, and the fraction of them that it must explain."""

MAX_RATIO_TO_PLANE = 0.5
"""Median error of the rotation over that of the best plane in disparity."""

MAX_OFF_ROW_PX = 1.0
"""Median distance by which the rotation moves matches off their rows: on rows they were found."""

ROBUST_ITERATIONS = 12

MIN_ROTATION_MATCHES, MAX_ROTATION_SAMPLES = 30, 50_000
"""With fewer disparities, one per cell, nothing is tried; more are not used."""


def check_images(gray0: np.ndarray, gray1: np.ndarray) -> None:
    """Refuse two copies of one image, also when one was saved again without visible loss.

    Copies that lost more show the same view: `check_matches` and `check_disparities` refuse them.

    Raises:
        NoDepthError: they are the same.

    Example:
        >>> check_images(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8))
        Traceback (most recent call last):
        ...
        deepdetect.NoDepthError: both images are the same: depth needs two images from two places
    """
    if gray0.shape != gray1.shape:
        return
    difference = cv2.absdiff(gray0, gray1)
    if difference.mean() >= MAX_MEAN_DIFFERENCE_LEVELS:
        return
    gradient = cv2.absdiff(gray0[:, 1:], gray0[:, :-1])
    limit = MAX_DIFFERENCE_TO_GRADIENT * np.quantile(gradient, DIFFERENCE_QUANTILE)
    if np.quantile(difference, DIFFERENCE_QUANTILE) <= min(MAX_DIFFERENCE_LEVELS, limit):
        raise NoDepthError("both images are the same: depth needs two images from two places")


def check_matches(
    points0: np.ndarray,
    points1: np.ndarray,
    size1: tuple[int, int],
    calibration: Calibration | None = None,
    seed: int = 0,
) -> tuple[np.ndarray, Scene]:
    """Refuse matches that show no overlap, no motion, or no depth.

    Args:
        points0, points1: (M, 2) float64 matched positions in pixels.
        size1: (width, height) of the second image.
        calibration: distinguishes a rotating camera from a plane, where it is known.
        seed: of the random samples.

    Returns:
        (K,) rows of the matches that were used, one per cell, and what these show.

    Raises:
        NoDepthError: too few matches agree with one geometry; nothing moves; or one
            homography explains them all.
    """
    indices = grid_subsample(points0, GRID_SIZE_PX, seed)
    scene = classify_scene(points0[indices], points1[indices], size1, calibration, seed)
    if scene.kind == "unrelated":
        raise NoDepthError(_no_overlap(len(points0)))
    if scene.kind != "depth":
        raise NoDepthError(NO_DEPTH[scene.kind])
    return indices, scene


def check_pose(
    pose: RelativePose | None, indices: np.ndarray, scene: Scene, calibration: Calibration
) -> RelativePose:
    """Refuse a pose that explains far less than is possible: the calibration is wrong.

    Args:
        pose: of all matches.
        indices, scene: as of `check_matches`.
        calibration: of the pose.

    Raises:
        ReconstructionError: too few matches agree with the pose, or too many points lie behind.
    """
    if pose is None:
        raise ReconstructionError(
            f"no pose of the cameras fits the matches: {_wrong_focal(calibration)}"
        )
    possible = np.count_nonzero(scene.epipolar.inliers)
    explained = np.count_nonzero(pose.errors[indices] < MAX_EPIPOLAR_DISTANCE_PX)
    if explained < MIN_POSE_RATIO * possible:
        raise ReconstructionError(
            f"with this calibration only {explained:,} of {possible:,} matches fit one pose of "
            f"the cameras: {_wrong_focal(calibration)}"
        )
    if pose.cheirality_ratio < MIN_IN_FRONT_FRACTION:
        raise ReconstructionError(
            f"only {pose.cheirality_ratio:.0%} of the points would lie in front of both cameras: "
            f"{_wrong_focal(calibration)}"
        )
    return pose


def check_focal(
    points0: np.ndarray,
    points1: np.ndarray,
    errors: np.ndarray,
    calibration: Calibration,
    seed: int = 0,
) -> None:
    """Refuse a focal length when quite another one fits the matches far better.

    Where the camera only moved sideways every focal length fits as well, and a wrong one is not
    noticed: it gives a scene that is stretched in depth. One that is too long is noticed less than
    one that is too short.

    Args:
        points0, points1: (M, 2) matches that a fundamental matrix explains.
        errors: (M,) Sampson distances of the pose, in pixels.
        calibration: of the pose.
        seed: of the random samples.

    Raises:
        ReconstructionError: another focal length halves the median error; it is named.
    """
    given = float(np.median(errors))
    if given < GOOD_ERROR_PX:
        return
    best, best_factor = MAX_FOCAL_ERROR_RATIO * given, 1.0
    for factor in FOCAL_FACTORS:
        scaled = replace(
            calibration,
            camera0=_with_focal(calibration.camera0, factor),
            camera1=_with_focal(calibration.camera1, factor),
        )
        found = estimate_relative_pose(points0, points1, scaled, MAX_EPIPOLAR_DISTANCE_PX, seed)
        if found is None or found.cheirality_ratio < MIN_IN_FRONT_FRACTION:
            continue
        error = float(np.median(found.errors))
        if error < best:
            best, best_factor = error, factor
    if best_factor != 1:
        focal = calibration.camera0.focal_px[0]
        raise ReconstructionError(
            f"{_wrong_focal(calibration)}: one of about {focal * best_factor:.0f} px fits the "
            f"matches {given / best:.1f} times as well"
        )


def check_cameras(calibration: Calibration) -> None:
    """Refuse a calibration that no rectified pair has.

    Raises:
        ReconstructionError: focal lengths or cy of both views differ.

    Example:
        >>> from deepdetect.geometry.camera import Camera
        >>> check_cameras(Calibration(Camera((640, 480), 500), Camera((640, 480), 600)))
        Traceback (most recent call last):
        ...
        deepdetect.ReconstructionError: the focal lengths of the left and the right view \
are 500 and 600 px, those of a rectified pair are one: fix the calibration (given), or pass \
`rectified=False`
    """
    camera0, camera1 = calibration.camera0, calibration.camera1
    advice = f"fix the calibration ({calibration.source}), or pass `rectified=False`"
    for focal0, focal1 in zip(camera0.focal_px, camera1.focal_px, strict=True):
        if abs(focal1 - focal0) > MAX_FOCAL_DIFFERENCE_FRACTION * focal0:
            raise ReconstructionError(
                f"the focal lengths of the left and the right view are {focal0:g} and {focal1:g} "
                f"px, those of a rectified pair are one: {advice}"
            )
    cy0, cy1 = camera0.centre[1], camera1.centre[1]
    if abs(cy1 - cy0) > MAX_CY_DIFFERENCE_PX:
        raise ReconstructionError(
            f"cy of the left and the right view are {cy0:g} and {cy1:g} px, those of a rectified "
            f"pair are one: {advice}"
        )


def check_keypoints(keypoints: int, selection: SelectionOptions) -> None:
    """Refuse an image without keypoints.

    Raises:
        NoDepthError: there are none.
    """
    if keypoints:
        return
    if selection.density is not None:
        raise NoDepthError(
            f"a density of {selection.density:g} gives no keypoint in the left image: raise "
            "`density`"
        )
    raise NoDepthError(
        f"no pixel of the left image is above the threshold of {selection.threshold:g}: lower "
        "`threshold`, or give `density` (an image of one grey level shows nothing)"
    )


def check_matched(matched: int, keypoints: int, unique: bool = True) -> None:
    """Refuse a pair treated as rectified of which hardly any keypoint has a match on its row.

    Args:
        matched: number of keypoints with a match; those in filled occlusions have none.
        keypoints: number of keypoints.
        unique: whether only matches count that no other place on the row comes near to.

    Raises:
        NoDepthError: there are too few.
    """
    least = MIN_UNIQUE_FRACTION if unique else MIN_MATCHED_FRACTION
    if matched < least * keypoints:
        raise NoDepthError(
            f"only {matched:,} of {keypoints:,} keypoints have a match on their row: the "
            "images hardly overlap or show different scenes, or the pair is not rectified"
        )


def check_disparities(disparity: np.ndarray) -> None:
    """Refuse disparities of a rectified pair that are all one value.

    Raises:
        NoDepthError: there are none, or they do not differ.

    Example:
        >>> check_disparities(np.full(100, 7.0))
        Traceback (most recent call last):
        ...
        deepdetect.NoDepthError: all disparities are 7 px: one image is the other \
shifted sideways, or both show one plane, and there is no depth
    """
    known = np.asarray(disparity)[np.isfinite(disparity)]
    if not len(known):
        raise NoDepthError("no disparity was found: the images do not overlap")
    if is_static(known):
        raise NoDepthError(
            "all disparities are 0: both images were taken from one place, without a baseline"
        )
    low, middle, high = np.quantile(known, [0.05, 0.5, 0.95])
    if high - low >= MIN_DISPARITY_SPREAD_PX:
        return
    raise NoDepthError(
        f"all disparities are {middle:.3g} px: one image is the other shifted sideways, or both "
        "show one plane, and there is no depth"
    )


def check_pure_rotation(
    pixels: np.ndarray,
    disparity: np.ndarray,
    calibration: Calibration,
) -> None:
    """Refuse disparities that a camera which only rotated explains.

    A rotation by an angle a about the vertical moves pixels along their rows by f a (1 + x^2) at
    first order, x the slope of the ray: about like a wall, but bent. With a focal length that is
    far off, with a tilt besides that takes matches off their rows, or when it bends by less than
    the noise, a rotation is not noticed.

    Raises:
        NoDepthError: one rotation explains most disparities, and far better than a plane.
    """
    chosen = np.arange(len(pixels))
    if len(chosen) > MAX_ROTATION_SAMPLES:
        chosen = np.random.default_rng(0).choice(len(chosen), MAX_ROTATION_SAMPLES, replace=False)
    chosen = chosen[grid_subsample(pixels[chosen], GRID_SIZE_PX)]
    if len(chosen) < MIN_ROTATION_MATCHES:
        return
    pixels, disparity = np.asarray(pixels, np.float64)[chosen], np.asarray(disparity)[chosen]
    by_rotation = _rotation_errors(pixels, disparity, calibration)
    by_plane = _plane_errors(pixels, disparity)
    better = np.median(by_rotation) < MAX_RATIO_TO_PLANE * np.median(by_plane)
    explained = np.mean(by_rotation < MAX_ROTATION_ERROR_PX)
    if better and explained > MIN_ROTATION_FRACTION:
        raise NoDepthError(
            "a rotation of the camera explains most disparities and there is no depth: move it "
            "sideways between the images"
        )


def check_depths(disparity: np.ndarray, calibration: Calibration) -> None:
    """Refuse disparities of a rectified pair of which many would lie behind the cameras.

    Raises:
        ReconstructionError: left and right are exchanged, or the offset is wrong.
    """
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
    """Fit a rotation to disparities robustly; (N,) what it leaves unexplained, in pixels.

    About the vertical and the line of sight: a tilt hardly changes disparities. Infinite when none
    leaves the matches on their rows.
    """
    camera = calibration.camera1
    rays = calibration.camera0.rays(pixels)
    wanted = (pixels[:, 0] - disparity - camera.centre[0]) / camera.focal_px[0]
    # The rotation about the vertical that most pixels ask for is near enough to begin with.
    angle = np.median(np.arctan(wanted) - np.arctan(rays[:, 0]))
    rotation = cv2.Rodrigues(np.array([0, angle, 0]))[0]
    error = np.empty(0)
    for iteration in range(ROBUST_ITERATIONS + 1):
        rotated = rays @ rotation.T
        if (rotated[:, 2] <= 0).any():  # only with a focal length that cannot be
            return np.full(len(pixels), np.inf)
        x, y = (rotated[:, :2] / rotated[:, 2:]).T
        error = wanted - x
        if iteration < ROBUST_ITERATIONS:
            slopes = np.column_stack([1 + x * x, -y])
            angles = _robust_step(slopes, error, camera.focal_px[0])
            rotation = cv2.Rodrigues(np.array([0, *angles]))[0] @ rotation
    off_row = y * camera.focal_px[1] + camera.centre[1] - pixels[:, 1]
    if np.median(np.abs(off_row)) > MAX_OFF_ROW_PX:
        return np.full(len(pixels), np.inf)
    return np.abs(error) * camera.focal_px[0]


def _plane_errors(pixels: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Fit disparities linear in x and y robustly; (N,) what they leave unexplained, in pixels."""
    design = np.column_stack([pixels / max(pixels.max(), 1), np.ones(len(pixels))])
    plane = np.array([0, 0, np.median(disparity)])
    for _ in range(ROBUST_ITERATIONS):
        plane = plane + _robust_step(design, disparity - design @ plane, 1.0)
    return np.abs(disparity - design @ plane)


def _robust_step(design: np.ndarray, error: np.ndarray, pixel: float) -> np.ndarray:
    """Return the change of parameters that lessens the sum of absolute errors (reweighting)."""
    weight = 1 / np.sqrt(np.maximum(np.abs(error) * pixel, 0.02))
    return np.linalg.lstsq(design * weight[:, None], error * weight, rcond=None)[0]


def _no_overlap(matches: int) -> str:
    if not matches:
        return (
            "there are no matches: the images do not overlap, or do not show the same scene, "
            "or no pixel of one is above the threshold (lower `threshold`, or give `density`)"
        )
    return (
        f"too few of the {matches:,} matches agree with one geometry: the images do not "
        "overlap, or do not show the same scene"
    )


def _wrong_focal(calibration: Calibration) -> str:
    return (
        f"the focal length of {calibration.camera0.focal_px[0]:.0f} px ({calibration.source}) is "
        "probably wrong for these images"
    )


def _with_focal(camera: Camera, factor: float) -> Camera:
    fx, fy = camera.focal_px
    return replace(camera, focal_px=(fx * factor, fy * factor))
