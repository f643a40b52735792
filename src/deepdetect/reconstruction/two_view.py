"""Triangulate 3D points from the matches of two calibrated images that are not rectified.

The pose is estimated from matches at corners that are refined to sub-pixel accuracy. Then all
matches are triangulated, without refinement. Checks in between raise an error that says why the
images give no depth.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from .._shared.errors import NoDepthError, ReconstructionError
from .._shared.progress import StageTimer
from ..features.matches import Matches
from ..features.selection import grid_subsample
from ..geometry import epipolar_errors
from ..geometry.camera import Calibration, Camera, fundamental_matrix
from ..geometry.relative_pose import RelativePose, estimate_relative_pose, triangulate
from ..geometry.two_view import SCENE_THRESHOLDS_PX
from .outliers import PointFilterOptions, disparity_space, sor_inliers
from .subpixel import refine_dense, spread_corners

MAX_EPIPOLAR_DISTANCE_PX, MAX_REPROJECTION_ERROR_PX = 1.0, 0.5
"""A match agrees with the pose if its Sampson distance is below MAX_EPIPOLAR_DISTANCE_PX, and its
root mean square reprojection error below MAX_REPROJECTION_ERROR_PX. Chosen by hand."""

POSE_CELLS, GRID_SIZE_PX = 10_000, 16
"""The pose is estimated from the strongest corner in each of about POSE_CELLS squares of the first
image. It is checked with one match per square of side GRID_SIZE_PX, because neighbouring matches
are not independent evidence. Chosen by hand."""

MAX_SCENE_DISTANCE_PX = SCENE_THRESHOLDS_PX["fundamental"]
"""Maximum Sampson distance of a match that fits a pose, the same as for a fundamental matrix."""

MIN_POSE_RATIO, MIN_IN_FRONT_FRACTION = 0.75, 0.75
"""A pose is accepted only if at least MIN_POSE_RATIO times as many matches fit it as fit the
fundamental matrix (a correct calibration gives about 1), and if at least MIN_IN_FRONT_FRACTION of
its inliers lie in front of both cameras. Chosen by hand."""

FOCAL_FACTORS, MAX_FOCAL_ERROR_RATIO = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0), 0.5
"""A focal length is rejected if multiplying it by one of FOCAL_FACTORS reduces the median Sampson
distance to less than MAX_FOCAL_ERROR_RATIO of its value. An error of a fifth is not noticed."""

GOOD_ERROR_PX = 0.1
"""No other focal length is tried if the median Sampson distance is below this. Chosen by hand."""

NO_DEPTH = {
    "none": "the matches agree with no geometry: the images do not overlap, show different scenes, "
    "or have no pixel above the threshold (lower `threshold`, or give `density`)",
    "still": "nothing moves between the images: depth needs two images from two places",
    "rotation": "a rotation explains all the matches: move the camera sideways between the images",
    "planar": "one homography explains all the matches: the images show a plane, or the camera "
    "only rotated, and there is no depth",
}
"""Error messages for the scenes (`TwoViewGeometry.scene`) that show no depth."""


def scene_with_depth(matches: Matches) -> tuple[Matches, np.ndarray]:
    """Return the matches of the main scene (layer 0), and its (3, 3) fundamental matrix.

    Raises a NoDepthError if the geometry of the matches shows no depth (`NO_DEPTH`).
    """
    geometry = matches.geometry
    assert geometry is not None
    if geometry.scene in NO_DEPTH:
        raise NoDepthError(NO_DEPTH[geometry.scene])
    assert geometry.matrix is not None
    return matches[matches.layer == 0], geometry.matrix


def refined_corners(
    images: tuple[np.ndarray, np.ndarray], points0: np.ndarray, points1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matches at corners that converge to sub-pixel accuracy, as two (K, 2) arrays."""
    pixels0 = np.rint(points0)
    rows = spread_corners(images[0], pixels0, POSE_CELLS)
    refined, converged = refine_dense(*images, pixels0[rows], points1[rows])
    return pixels0[rows][converged], refined[converged]


def reconstruct_two_view(
    matches: Matches,
    images: tuple[np.ndarray, np.ndarray],
    calibration: Calibration,
    point_filter: PointFilterOptions,
    seed: int,
    timer: StageTimer,
) -> dict[str, Any]:
    """Triangulate the matches of two uint8 luma images; return fields of `Reconstruction`."""
    matches, guide = scene_with_depth(matches)
    points0, points1 = matches.points0.astype(np.float64), matches.points1.astype(np.float64)
    dropped: dict[str, int] = {}
    with timer.stage("sub-pixel"):
        corners = refined_corners(images, points0, points1)
    pose = checked_pose(*corners, guide, calibration, seed, timer)
    baseline = 1.0 if calibration.baseline_mm is None else calibration.baseline_mm
    with timer.stage("triangulation"):
        shift = pose.translation * baseline
        made = triangulate(points0, points1, calibration, pose.rotation, shift)
    fundamental = fundamental_matrix(calibration, pose.rotation, pose.translation)
    near_line = epipolar_errors(points0, points1, fundamental) < MAX_EPIPOLAR_DISTANCE_PX
    focal = calibration.camera0.focal_px[0]
    kept = np.ones(len(points0), bool)
    for reason, passed in (
        ("far from its epipolar line", near_line),
        ("behind a camera", made.cheirality),
        ("reprojection error", made.reprojection_errors < MAX_REPROJECTION_ERROR_PX),
        ("parallax", made.triangulation_angle * focal >= point_filter.min_parallax_px),
    ):
        dropped[reason] = int(np.count_nonzero(kept & ~passed))
        kept &= passed
    if point_filter.sor_neighbors:
        with timer.stage("outlier removal"):
            space = disparity_space(made.points[kept], focal, baseline)
            inliers = sor_inliers(space, point_filter)
        dropped["statistical outlier"] = int(np.count_nonzero(~inliers))
        kept[kept] = inliers
    if not kept.any():
        counts = ", ".join(f"{reason}: {count:,}" for reason, count in dropped.items() if count)
        raise ReconstructionError(
            f"all of the {len(points0):,} matches were filtered out ({counts}): take images that "
            "overlap more, or check the calibration"
        )
    return {
        "points": made.points[kept].astype(np.float32),
        "pixels": matches.points0[kept],
        "disparity": None,
        "matched": np.ones(np.count_nonzero(kept), bool),
        "pose": pose,
        "reprojection_errors": made.reprojection_errors[kept].astype(np.float32),
        "keypoints": len(matches.keypoints0),
        "matches": len(matches),
        "dropped": dropped,
    }


def checked_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    fundamental: np.ndarray,
    calibration: Calibration,
    seed: int,
    timer: StageTimer,
) -> RelativePose:
    """Estimate the pose from refined (M, 2) matches, or raise an error that says why it fails.

    The pose is checked against the fundamental matrix, which was fitted without a calibration.
    """
    cells = grid_subsample(points0, GRID_SIZE_PX, seed)
    errors = epipolar_errors(points0[cells], points1[cells], fundamental)
    with timer.stage("pose"):
        found = estimate_relative_pose(
            points0, points1, calibration, MAX_EPIPOLAR_DISTANCE_PX, seed
        )
        pose = check_pose(found, cells, errors < MAX_SCENE_DISTANCE_PX, calibration)
    with timer.stage("focal length"):
        explained = cells[errors < MAX_SCENE_DISTANCE_PX]
        on_lines = points0[explained], points1[explained]
        check_focal(*on_lines, pose.errors[explained], calibration, seed)
    return pose


def check_pose(
    pose: RelativePose | None, cells: np.ndarray, explained: np.ndarray, calibration: Calibration
) -> RelativePose:
    """Return the given pose, or raise a ReconstructionError if the calibration is wrong.

    `cells` (K,) are the indices of the tested matches; `explained` (K,) bool tells which of them
    fit the fundamental matrix. The calibration is wrong if far fewer of them fit the pose.
    """
    wrong_focal = _wrong_focal(calibration)
    if pose is None:
        raise ReconstructionError(f"no pose fits the matches: {wrong_focal}")
    possible = np.count_nonzero(explained)
    count = np.count_nonzero(pose.errors[cells] < MAX_SCENE_DISTANCE_PX)
    if count < MIN_POSE_RATIO * possible:
        raise ReconstructionError(
            f"only {count:,} of {possible:,} matches fit one pose: {wrong_focal}"
        )
    if pose.cheirality_ratio < MIN_IN_FRONT_FRACTION:
        raise ReconstructionError(
            f"only {pose.cheirality_ratio:.0%} of the points are in front of both cameras: "
            f"{wrong_focal}"
        )
    return pose


def check_focal(
    points0: np.ndarray,
    points1: np.ndarray,
    errors: np.ndarray,
    calibration: Calibration,
    seed: int = 0,
) -> None:
    """Raise a ReconstructionError if a very different focal length fits the matches far better.

    The (M, 2) matches fit the fundamental matrix, and `errors` (M,) are their Sampson distances
    under the pose. If the camera only moved sideways, every focal length fits.
    """
    given = float(np.median(errors))
    if given < GOOD_ERROR_PX:
        return
    best, best_factor = MAX_FOCAL_ERROR_RATIO * given, 1.0
    for factor in FOCAL_FACTORS:
        camera0, camera1 = (
            Camera(camera.size, [factor * focal for focal in camera.focal_px], camera.centre)
            for camera in (calibration.camera0, calibration.camera1)
        )
        scaled = replace(calibration, camera0=camera0, camera1=camera1)
        found = estimate_relative_pose(points0, points1, scaled, MAX_SCENE_DISTANCE_PX, seed)
        if found is None or found.cheirality_ratio < MIN_IN_FRONT_FRACTION:
            continue
        error = float(np.median(found.errors))
        if error < best:
            best, best_factor = error, factor
    if best_factor != 1:
        focal = calibration.camera0.focal_px[0]
        raise ReconstructionError(
            f"{_wrong_focal(calibration)}: about {focal * best_factor:.0f} px fits the matches "
            f"{given / best:.1f} times as well"
        )


def _wrong_focal(calibration: Calibration) -> str:
    return (
        f"the focal length of {calibration.camera0.focal_px[0]:.0f} px ({calibration.source}) is "
        "probably wrong for these images"
    )
