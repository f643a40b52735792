"""Why a pose or its focal length cannot be right, in one sentence and before any cloud is made.

The checks of a pair whose matches have passed `check_matches`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .._shared.errors import ReconstructionError
from ..geometry.camera import Calibration, Camera
from ..geometry.relative_pose import RelativePose, estimate_relative_pose
from .checks import CheckOptions, Evidence


def check_pose(
    pose: RelativePose | None,
    evidence: Evidence,
    calibration: Calibration,
    options: CheckOptions = CheckOptions(),
) -> RelativePose:
    """Refuse a pose that explains far less than is possible: the calibration is wrong.

    Raises:
        ReconstructionError: too few matches agree with the pose, or too many points lie behind.
    """
    if pose is None:
        raise ReconstructionError(
            f"no pose of the cameras fits the matches: {_wrong_focal(calibration)}"
        )
    possible = np.count_nonzero(evidence.explained)
    errors = pose.errors[evidence.indices]
    explained = np.count_nonzero(errors < options.max_epipolar_distance_px)
    if explained < options.min_pose_ratio * possible:
        raise ReconstructionError(
            f"with this calibration only {explained:,} of {possible:,} matches fit one pose of "
            f"the cameras: {_wrong_focal(calibration)}"
        )
    if pose.cheirality_ratio < options.min_in_front_fraction:
        raise ReconstructionError(
            f"only {pose.cheirality_ratio:.0%} of the points would lie in front of both cameras: "
            f"{_wrong_focal(calibration)}"
        )
    return pose


def check_focal(
    points0: np.ndarray,
    points1: np.ndarray,
    pose: RelativePose,
    evidence: Evidence,
    calibration: Calibration,
    seed: int = 0,
    options: CheckOptions = CheckOptions(),
) -> None:
    """Refuse a focal length when quite another one fits the matches far better.

    Where the camera only moved sideways every focal length fits as well, and a wrong one is not
    noticed: it gives a scene that is stretched in depth. One that is too long is noticed less than
    one that is too short.

    Raises:
        ReconstructionError: another focal length halves the median error; it is named.
    """
    indices = evidence.indices[evidence.explained]
    first, second = points0[indices], points1[indices]
    given = float(np.median(pose.errors[indices]))
    if given < options.good_error_px:
        return
    best, best_factor = options.max_focal_error_ratio * given, 1.0
    for factor in options.focal_factors:
        scaled = replace(
            calibration,
            camera0=_with_focal(calibration.camera0, factor),
            camera1=_with_focal(calibration.camera1, factor),
        )
        found = estimate_relative_pose(
            first, second, scaled, options.max_epipolar_distance_px, seed
        )
        if found is None or found.cheirality_ratio < options.min_in_front_fraction:
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


def _wrong_focal(calibration: Calibration) -> str:
    return (
        f"the focal length of {calibration.camera0.focal_px[0]:.0f} px ({calibration.source}) is "
        "probably wrong for these images"
    )


def _with_focal(camera: Camera, factor: float) -> Camera:
    fx, fy = camera.focal_px
    return replace(camera, focal_px=(fx * factor, fy * factor))
