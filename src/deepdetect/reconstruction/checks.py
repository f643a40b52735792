"""Why two images give no depth, in one sentence and before any cloud is made.

Each check raises an error when its reason holds, and is silent on good pairs. They run in this
order: `check_images`, `check_matches`, then `check_pose` and `check_focal`; for rectified pairs
`check_images`, then those of `rectified_checks`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._shared.errors import NoDepthError, ReconstructionError
from .._shared.opencv import cv2
from ..features.selection import grid_subsample
from ..geometry.camera import Calibration, Camera
from ..geometry.relative_pose import RelativePose, estimate_relative_pose
from ..geometry.two_view import SCENE_THRESHOLDS_PX, Scene, classify_scene

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
