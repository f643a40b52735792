"""Where the second camera stands and how it is turned, from matches of calibrated images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from . import GeometryOptions, epipolar_errors, estimate_geometry
from .camera import Calibration
from .triangulation import fundamental_matrix, triangulate

ROUNDS = 10
STEP = 1e-6
"""Radians by which the pose is varied for its derivatives."""

SETTLED = 1e-9
"""A smaller change of the pose, in radians, ends the refinement."""

REPEATS = 4
LEAST_MORE = 0.01
"""How often the pose is fitted anew to its own inliers, while that gives so many more of them."""

MOST = 50_000
"""Matches that the refinement takes, evenly from all: more do not make the pose any better."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The pose of the second camera: X1 = rotation @ X0 + translation.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 of length 1: only its direction can be known.
        inliers: (M,) bool, the matches nearer to their epipolar lines than the threshold.
        errors: (M,) float64 distances from them in pixels (Sampson's).
        cheirality_ratio: share of the inliers that lie in front of both cameras, in [0, 1].
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    errors: np.ndarray
    cheirality_ratio: float

    @property
    def angle(self) -> float:
        """The angle by which the second camera is turned, in degrees."""
        return rotation_angle(self.rotation)


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle of a rotation in degrees, exact for small ones too.

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
    refine: bool = True,
) -> RelativePose | None:
    """Estimate the pose: essential matrix by MAGSAC, the one of its four poses that sees most.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        calibration: of both cameras.
        inlier_threshold: in pixels, Sampson's distance.
        seed: of the random samples.
        refine: fit the pose to all inliers afterwards (`refine_pose`).

    Returns:
        The pose, or None where there are too few matches or none can be estimated.

    Raises:
        OptionError: the threshold or the seed is out of its range.
    """
    options = GeometryOptions(
        model="essential",
        inlier_threshold=inlier_threshold,
        camera0=calibration.camera0.matrix,
        camera1=calibration.camera1.matrix,
        seed=seed,
    )
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    geometry = estimate_geometry(points0, points1, options)
    if geometry.matrix is None or not geometry.inliers.any():
        return None
    kept = geometry.inliers
    pose = _best_of_four(geometry.matrix, points0[kept], points1[kept], calibration)
    for _ in range(REPEATS if refine else 0):
        pose = refine_pose(points0[kept], points1[kept], calibration, *pose, inlier_threshold)
        before = np.count_nonzero(kept)
        errors = epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))
        kept = errors < inlier_threshold
        if np.count_nonzero(kept) <= before * (1 + LEAST_MORE):
            break
    rotation, translation = pose
    errors = epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))
    inliers = errors < inlier_threshold
    if not inliers.any():
        return None
    share = _cheirality_ratio(
        points0[inliers], points1[inliers], calibration, rotation, translation
    )
    return RelativePose(rotation, translation, inliers, errors, share)


def refine_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
    scale: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a pose to matches: least sum of squares of Sampson's distances, far ones weighed less.

    Gauss-Newton on three angles of the rotation and two of the direction of the translation, with
    Cauchy's weights.

    Args:
        points0, points1: (M, 2) matched positions in pixels, mostly right.
        calibration: of both cameras.
        rotation, translation: where to begin.
        scale: at half of this distance in pixels a match weighs half.

    Returns:
        (3, 3) rotation and (3,) translation of length 1; never worse than at the beginning.
    """
    every = -(-len(points0) // MOST)
    points0, points1 = points0[::every], points1[::every]

    def residuals(pose: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return _signed_errors(points0, points1, fundamental_matrix(calibration, *pose))

    def cost(values: np.ndarray) -> float:
        return float(np.log1p((values / (scale / 2)) ** 2).sum())

    pose = rotation, translation / np.linalg.norm(translation)
    here = residuals(pose)
    best = cost(here)
    for _ in range(ROUNDS):
        steps = np.eye(5) * STEP
        slopes = np.column_stack([(residuals(_moved(pose, s)) - here) / STEP for s in steps])
        weights = 1 / (1 + (here / (scale / 2)) ** 2)
        normal = slopes.T @ (slopes * weights[:, None])
        change = -np.linalg.lstsq(normal, slopes.T @ (weights * here), rcond=None)[0]
        while np.abs(change).max() > SETTLED:
            there = _moved(pose, change)
            values = residuals(there)
            if cost(values) < best:
                break
            change = change / 4
        else:
            break
        pose, here, best = there, values, cost(values)
    return pose


def _moved(
    pose: tuple[np.ndarray, np.ndarray], change: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn the rotation by three small angles, and the translation by two across itself."""
    rotation, translation = pose
    turn = cv2.Rodrigues(np.asarray(change[:3], np.float64))[0]
    least = np.eye(3)[np.abs(translation).argmin()]
    across = np.cross(translation, least)
    across /= np.linalg.norm(across)
    moved = translation + change[3] * across + change[4] * np.cross(translation, across)
    return turn @ rotation, moved / np.linalg.norm(moved)


def _signed_errors(points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray) -> np.ndarray:
    lines1 = points0 @ fundamental[:, :2].T + fundamental[:, 2]
    lines0 = points1 @ fundamental[:2, :2] + fundamental[2, :2]
    algebraic = (points1 * lines1[:, :2]).sum(1) + lines1[:, 2]
    gradient = (lines1[:, :2] ** 2).sum(1) + (lines0**2).sum(1)
    return algebraic / np.sqrt(np.maximum(gradient, 1e-300))


def _best_of_four(
    essential: np.ndarray, points0: np.ndarray, points1: np.ndarray, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of an essential matrix that has most points before both cameras."""
    rotation0, rotation1, translation = cv2.decomposeEssentialMat(essential)
    every = -(-len(points0) // MOST)
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
