"""Relative pose of two calibrated cameras, from matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.opencv import cv2
from .camera import Calibration
from .estimation import GeometryOptions, estimate_geometry
from .residuals import epipolar_errors, signed_epipolar_errors
from .triangulation import fundamental_matrix, triangulate

MAX_ITERATIONS = 10
"""Of Gauss-Newton."""

DERIVATIVE_STEP = 1e-6
"""By which the pose is varied for its derivatives, in radians."""

MIN_CHANGE = 1e-9
"""A smaller change of the pose, in radians, ends the refinement."""

MAX_REFITS = 4
"""How often the pose is fitted to its own inliers again ..."""

MIN_INLIER_GAIN = 0.01
"""... while that gives this fraction of further inliers."""

MAX_MATCHES = 50_000
"""That are used, sampled evenly: more do not improve the pose."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The pose of the second camera: X1 = rotation @ X0 + translation.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 of length 1: only its direction can be known.
        inliers: (M,) bool, the matches with an error below the threshold.
        errors: (M,) float64 Sampson distances in pixels.
        cheirality_ratio: fraction of the inliers that lie in front of both cameras, in [0, 1].
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    errors: np.ndarray
    cheirality_ratio: float

    @property
    def angle(self) -> float:
        """The angle of the rotation in degrees."""
        return rotation_angle(self.rotation)


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle of a rotation in degrees, accurate for small angles, too.

    Example:
        >>> round(rotation_angle(np.eye(3)), 6)
        0.0
    """
    skew = (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]]
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))


def estimate_relative_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    inlier_threshold: float = 1.0,
    seed: int = 0,
) -> RelativePose | None:
    """Estimate the pose: essential matrix by MAGSAC, the best of its four poses, refined.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        calibration: of both cameras.
        inlier_threshold: Sampson distance in pixels.
        seed: of the random samples.

    Returns:
        The pose, or None when there are too few matches or it cannot be estimated.

    Raises:
        OptionError: the threshold or the seed is out of its range.
    """
    essential = GeometryOptions(
        inlier_threshold=inlier_threshold,
        camera0=calibration.camera0.matrix,
        camera1=calibration.camera1.matrix,
    )
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    every = -(-len(points0) // MAX_MATCHES) if len(points0) else 1
    geometry = estimate_geometry(
        points0[::every], points1[::every], "essential", seed=seed, options=essential
    )
    if geometry.matrix is None or not geometry.inliers.any():
        return None
    kept = np.zeros(len(points0), bool)
    kept[::every] = geometry.inliers
    inliers = points0[kept], points1[kept]
    pose = best_of_four(geometry.matrix, *inliers, calibration)
    for _ in range(MAX_REFITS):
        inliers = points0[kept], points1[kept]
        pose = refine_pose(*inliers, calibration, *pose, scale_px=inlier_threshold)
        before = np.count_nonzero(kept)
        errors = epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))
        kept = errors < inlier_threshold
        if np.count_nonzero(kept) <= before * (1 + MIN_INLIER_GAIN):
            break
    errors = epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))
    kept = errors < inlier_threshold
    if not kept.any():
        return None
    sample = np.flatnonzero(kept)
    sample = sample[:: -(-len(sample) // MAX_MATCHES)]
    ratio = _cheirality_ratio(points0[sample], points1[sample], calibration, *pose)
    return RelativePose(*pose, inliers=kept, errors=errors, cheirality_ratio=ratio)


def refine_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
    scale_px: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a pose to matches: Sampson distances with a Cauchy loss, by Gauss-Newton.

    The parameters are three angles of the rotation and two of the direction of the translation.

    Args:
        points0, points1: (M, 2) matched positions in pixels, mostly right.
        calibration: of both cameras.
        rotation, translation: initial pose.
        scale_px: a match with half this error has half the weight of an exact one.

    Returns:
        (3, 3) rotation and (3,) translation of length 1; never worse than the initial pose.
    """
    every = -(-len(points0) // MAX_MATCHES)
    points0, points1 = points0[::every], points1[::every]

    def residuals(pose: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return signed_epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))

    def cost(values: np.ndarray) -> float:
        return float(np.log1p((values / (scale_px / 2)) ** 2).sum())

    pose = rotation, translation / np.linalg.norm(translation)
    here = residuals(pose)
    best = cost(here)
    for _ in range(MAX_ITERATIONS):
        varied = (residuals(moved_pose(pose, axis)) for axis in np.eye(5) * DERIVATIVE_STEP)
        slopes = np.column_stack([(there - here) / DERIVATIVE_STEP for there in varied])
        weights = 1 / (1 + (here / (scale_px / 2)) ** 2)
        normal = slopes.T @ (slopes * weights[:, None])
        change = -np.linalg.lstsq(normal, slopes.T @ (weights * here), rcond=None)[0]
        while np.abs(change).max() > MIN_CHANGE:
            there = moved_pose(pose, change)
            values = residuals(there)
            if cost(values) < best:
                break
            change = change / 4
        else:
            break
        pose, here, best = there, values, cost(values)
    return pose


def moved_pose(
    pose: tuple[np.ndarray, np.ndarray], change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a pose near another: a change of 5 angles in radians.

    Three rotate the rotation, two move the translation, of length 1, across itself.
    """
    rotation, translation = pose
    small = cv2.Rodrigues(np.asarray(change[:3], np.float64))[0]
    least = np.eye(3)[np.abs(translation).argmin()]
    across = _cross(translation, least)
    across /= np.linalg.norm(across)
    moved = translation + change[3] * across + change[4] * _cross(translation, across)
    return small @ rotation, moved / np.linalg.norm(moved)


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return what `np.cross` does of two vectors, in a tenth of the time."""
    (x0, y0, z0), (x1, y1, z1) = first.tolist(), second.tolist()
    return np.array([y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1])


def best_of_four(
    essential: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of an essential matrix with most points in front of both cameras.

    Args:
        essential: (3, 3), in normalised coordinates.
        points0, points1: (M, 2) matched positions in pixels.
        calibration: of both cameras.

    Returns:
        (3, 3) rotation and (3,) translation of length 1.
    """
    rotation0, rotation1, translation = cv2.decomposeEssentialMat(essential)
    every = -(-len(points0) // MAX_MATCHES)
    points0, points1 = points0[::every], points1[::every]
    poses = [
        (rotation, sign * translation.ravel())
        for rotation in (rotation0, rotation1)
        for sign in (1, -1)
    ]
    return max(poses, key=lambda pose: _cheirality_ratio(points0, points1, calibration, *pose))


def _cheirality_ratio(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> float:
    return float(
        triangulate(points0, points1, calibration, rotation, translation).cheirality.mean()
    )
