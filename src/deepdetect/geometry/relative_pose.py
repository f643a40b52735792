"""Estimate the relative pose of two calibrated cameras from matches, and triangulate matches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from .._shared.opencv import cv2
from .camera import Calibration, fundamental_matrix
from .estimation import GeometryOptions, estimate_geometry
from .transforms import epipolar_errors, epipolar_slopes, signed_epipolar_errors

Pose = tuple[np.ndarray, np.ndarray]
"""A rotation (3, 3) and a translation (3,). They map a point X0 in the frame of the first camera to
X1 = rotation @ X0 + translation in the frame of the second."""

T = TypeVar("T")

BLOCK, MAX_MATCHES = 100_000, 50_000
"""`triangulate` processes at most BLOCK matches at once, because it needs much memory. A pose is
fitted to at most MAX_MATCHES, because more do not improve it."""

MAX_ITERATIONS, DERIVATIVE_STEP, MIN_GAIN = 20, 1e-6, 1e-7
"""Levenberg-Marquardt stops after MAX_ITERATIONS steps, or if one lowers the loss by less than the
fraction MIN_GAIN. Numerical derivatives of the matrix vary each parameter by DERIVATIVE_STEP.
Chosen by hand."""

MIN_SIGMA_PX = 0.03
"""Added to the standard deviations of matches from their covariances, since no match is exact."""

MAX_REFITS, MIN_INLIER_GAIN = 4, 0.01
"""A pose is refitted to its inliers at most MAX_REFITS times, while their number grows by more than
the fraction MIN_INLIER_GAIN. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Points triangulated from N matches.

    Attributes:
        points: (N, 3) float64 in the frame of the first camera; not finite where the two rays are
            parallel.
        cheirality: (N,) bool, True for points in front of both cameras.
        reprojection_errors: (N,) root mean square, in pixels, of the errors in the two images.
        triangulation_angle: (N,) angles between the two rays, in radians.
    """

    points: np.ndarray
    cheirality: np.ndarray
    reprojection_errors: np.ndarray
    triangulation_angle: np.ndarray


def triangulate(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> Triangulation:
    """Triangulate (N, 2) matches in pixels; the pose is X1 = rotation @ X0 + translation.

    First, `correct_matches` makes the two rays of each match meet (maximum likelihood).
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    if len(points0) > BLOCK:
        parts = [slice(start, start + BLOCK) for start in range(0, len(points0), BLOCK)]
        pose = calibration, rotation, translation
        blocks = [vars(triangulate(points0[part], points1[part], *pose)).values() for part in parts]
        return Triangulation(*map(np.concatenate, zip(*blocks, strict=True)))
    rotation, translation = (np.asarray(part, np.float64) for part in (rotation, translation))
    fundamental = fundamental_matrix(calibration, rotation, translation)
    moved0, moved1 = correct_matches(points0, points1, fundamental)
    camera0, camera1 = calibration.camera0, calibration.camera1
    rays0, rays1 = camera0.rays(moved0), camera1.rays(moved1)
    rotated = rays0 @ rotation.T
    # Solve ray1 x (depth * rotated + translation) = 0 for the depth.
    normals = np.cross(rays1, rotated)
    squares = np.einsum("ij,ij->i", normals, normals)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -np.einsum("ij,ij->i", normals, np.cross(rays1, translation)) / squares
        points = rays0 * depth[:, None]
    depth1 = (points @ rotation.T + translation)[:, 2]
    cheirality = np.isfinite(depth) & (depth > 0) & (depth1 > 0)
    error = ((moved0 - points0) ** 2).sum(1) + ((moved1 - points1) ** 2).sum(1)
    angle = np.arctan2(np.sqrt(squares), np.einsum("ij,ij->i", rays1, rotated))
    return Triangulation(points, cheirality, np.sqrt(error / 2), angle)


def correct_matches(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move (N, 2) matches as little as possible so that x1^T F x0 = 0 holds.

    This is the algorithm niter2 of Lindstrom, "Triangulation made easy", 2010.
    """
    first = np.column_stack([points0, np.ones(len(points0))])
    second = np.column_stack([points1, np.ones(len(points1))])
    block = fundamental[:2, :2]
    normal0 = second @ fundamental[:, :2]  # gradients of the constraint
    normal1 = first @ fundamental.T[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        a = np.einsum("ij,ij->i", normal1 @ block, normal0)
        b = ((normal0**2).sum(1) + (normal1**2).sum(1)) / 2
        c = np.einsum("ij,ij->i", second @ fundamental, first)
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        step = c / (b + root)
        next0 = normal0 - step[:, None] * (normal1 @ block)
        next1 = normal1 - step[:, None] * (normal0 @ block.T)
        step = step * 2 * root / ((next0**2).sum(1) + (next1**2).sum(1))
        moved0 = points0 - step[:, None] * next0
        moved1 = points1 - step[:, None] * next1
    # A match at an epipole has no finite correction and needs none: all lines there are epipolar.
    known = np.isfinite(moved0).all(1) & np.isfinite(moved1).all(1)
    return np.where(known[:, None], moved0, points0), np.where(known[:, None], moved1, points1)


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The pose of the second camera in the frame of the first, estimated from M matches.

    A point X0 in the frame of the first camera is X1 = rotation @ X0 + translation in the frame of
    the second.

    Attributes:
        rotation: (3, 3) float64.
        translation: (3,) float64 of length 1, because only its direction can be known.
        inliers: (M,) bool, True for matches with an error below the threshold.
        errors: (M,) float64 Sampson distances of all matches in pixels.
        cheirality_ratio: fraction of the inliers that lie in front of both cameras, in [0, 1].
        left_out: fraction of the image that `estimate_pose` ignored: overlays that stand still.
    """

    rotation: np.ndarray
    translation: np.ndarray
    inliers: np.ndarray
    errors: np.ndarray
    cheirality_ratio: float
    left_out: float = 0.0

    @property
    def angle(self) -> float:
        """The angle of the rotation in degrees."""
        return rotation_angle(self.rotation)


def rotation_angle(rotation: np.ndarray) -> float:
    """Return the angle of a rotation in degrees; small angles are also accurate."""
    skew = (rotation - rotation.T)[[2, 0, 1], [1, 2, 0]]
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))


def estimate_relative_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    inlier_threshold: float = 1.0,
    seed: int = 0,
    covariances: np.ndarray | None = None,
) -> RelativePose | None:
    """Estimate the pose of the second of two calibrated cameras, by MAGSAC and a refinement.

    Args:
        points0, points1: (M, 2) matching positions in pixels of the images. The centre of the first
            pixel is (0, 0).
        calibration: both cameras, without distortion.
        inlier_threshold: maximum Sampson distance of an inlier in pixels.
        seed: seed of the random samples.
        covariances: (M, 2, 2) of `points1` in square pixels, such as `Matches.covariances` after
            `refine_matches`. The refinement weights matches by them. None: equal weights.

    Returns:
        The pose; None if there are too few matches or the estimation fails.

    Example:
        >>> from deepdetect.geometry.camera import Calibration, Camera
        >>> camera = Camera((640, 480), 500.0)
        >>> points = np.random.default_rng(0).uniform((-2, -2, 4), (2, 2, 8), (50, 3))
        >>> first, second = camera.project(points), camera.project(points - [0.5, 0, 0])
        >>> pose = estimate_relative_pose(first, second, Calibration(camera, camera))
        >>> pose.translation.round(3) + 0.0
        array([-1.,  0.,  0.])
    """
    matrices = calibration.camera0.matrix, calibration.camera1.matrix
    essential = GeometryOptions(inlier_threshold, None, *matrices)
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    sample = _evenly(np.arange(len(points0)))
    geometry = estimate_geometry(
        points0[sample], points1[sample], "essential", seed=seed, options=essential
    )
    if geometry.matrix is None or not geometry.inliers.any():
        return None
    kept = np.zeros(len(points0), bool)
    kept[sample] = geometry.inliers
    pose = best_of_four(geometry.matrix, points0[kept], points1[kept], calibration)
    for _ in range(MAX_REFITS):
        before = np.count_nonzero(kept)
        inliers = points0[kept], points1[kept]
        known = None if covariances is None else np.asarray(covariances)[kept]
        pose = refine_pose(*inliers, calibration, *pose, inlier_threshold, known)
        errors = epipolar_errors(points0, points1, fundamental_matrix(calibration, *pose))
        kept = errors < inlier_threshold
        if np.count_nonzero(kept) <= before * (1 + MIN_INLIER_GAIN):
            break
    if not kept.any():
        return None
    sample = _evenly(np.flatnonzero(kept))
    ratio = _cheirality_ratio(points0[sample], points1[sample], calibration, pose)
    return RelativePose(*pose, inliers=kept, errors=errors, cheirality_ratio=ratio)


def refine_pose(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
    scale_px: float = 1.0,
    covariances: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Refine a pose by the Sampson distances of (M, 2) matches, most of them correct.

    A Cauchy loss is minimised over five angles: three of the rotation and two of the direction of
    the translation. The loss never rises above that of the initial pose. A match with a Sampson
    distance of `scale_px` / 2 has half the weight of an exact match. If `covariances` of `points1`
    are given, twice the standard deviation of this distance takes the place of `scale_px` / 2.
    """
    points0, points1 = _evenly(points0), _evenly(points1)
    pose = rotation, translation / np.linalg.norm(translation)
    sigmas = np.full(len(points0), scale_px / 4)
    if covariances is not None:
        fundamental, ones = fundamental_matrix(calibration, *pose), np.ones((len(points0), 1))
        lines1 = (np.hstack([points0, ones]) @ fundamental.T)[:, :2]
        lines0 = (np.hstack([points1, ones]) @ fundamental)[:, :2]
        across = np.einsum("ni,nij,nj->n", lines1, _evenly(covariances), lines1)
        gradient = (lines1**2 + lines0**2).sum(axis=1)  # of the Sampson distance
        sigmas = np.sqrt(across / gradient.clip(np.finfo(float).tiny)) + MIN_SIGMA_PX
    return fit_to_lines(
        pose,
        points0,
        points1,
        sigmas,
        lambda pose: fundamental_matrix(calibration, *pose),
        moved_pose,
        np.eye(5),
    )


def fit_to_lines(
    start: T,
    points0: np.ndarray,
    points1: np.ndarray,
    sigmas: np.ndarray,
    matrix_of: Callable[[T], np.ndarray],
    moved: Callable[[T, np.ndarray], T],
    axes: np.ndarray,
    prior: Callable[[T], np.ndarray] = lambda _: np.empty(0),
) -> T:
    """Fit the parameters of a fundamental matrix, such as a pose, to (M, 2) matches (Cauchy loss).

    Levenberg-Marquardt begins at `start`. `moved` changes parameters by a step; the rows of `axes`
    are unit steps, one per degree of freedom. `matrix_of` computes the matrix. Errors of matches
    are divided by `sigmas`, (M,) in pixels; `prior` returns deviations divided by their sigmas.
    """
    count, damping = len(points0), 1e-3

    def residuals(view: T) -> np.ndarray:
        errors = signed_epipolar_errors(points0, points1, matrix_of(view))
        return np.append(errors / sigmas, prior(view))

    def cost(errors: np.ndarray) -> float:
        matches, usual = errors[:count], errors[count:]
        return float(2 * np.log1p((matches / 2) ** 2).sum() + (usual**2).sum() / 2)

    errors = residuals(start)
    lowest = cost(errors)
    for _ in range(MAX_ITERATIONS):
        matrix, varied = matrix_of(start), [moved(start, axis * DERIVATIVE_STEP) for axis in axes]
        of_matrix = np.stack([(matrix_of(each) - matrix).ravel() for each in varied], axis=1)
        of_prior = np.stack([prior(each) - errors[count:] for each in varied], axis=1)
        of_matches = epipolar_slopes(points0, points1, matrix) @ of_matrix / sigmas[:, None]
        slopes = np.vstack([of_matches, of_prior]) / DERIVATIVE_STEP
        weights = np.ones(len(errors))
        weights[:count] = 1 / (1 + (errors[:count] / 2) ** 2)
        normal, gradient = slopes.T @ (slopes * weights[:, None]), slopes.T @ (weights * errors)
        before = lowest
        while damping < 1e6:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            changed = moved(start, -np.linalg.solve(damped, gradient))
            changed_errors = residuals(changed)
            if cost(changed_errors) < lowest:
                start, errors, lowest = changed, changed_errors, cost(changed_errors)
                damping /= 5
                break
            damping *= 5
        if before - lowest <= MIN_GAIN * before:
            break
    return start


def moved_pose(pose: Pose, change: np.ndarray) -> Pose:
    """Change a pose by five small angles: three of the rotation, two of the direction."""
    rotation, translation = pose
    small = cv2.Rodrigues(np.asarray(change[:3], np.float64))[0]
    least = np.eye(3)[np.abs(translation).argmin()]
    across = _cross(translation, least)
    across /= np.linalg.norm(across)
    moved = translation + change[3] * across + change[4] * _cross(translation, across)
    return small @ rotation, moved / np.linalg.norm(moved)


def _cross(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross product of two (3,) vectors, in a tenth of the time of `np.cross`."""
    (x0, y0, z0), (x1, y1, z1) = first.tolist(), second.tolist()
    return np.array([y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1])


def best_of_four(
    essential: np.ndarray, points0: np.ndarray, points1: np.ndarray, calibration: Calibration
) -> tuple[np.ndarray, np.ndarray]:
    """Return the one of an essential matrix's four poses with most points before both cameras."""
    rotation0, rotation1, translation = cv2.decomposeEssentialMat(essential)
    points0, points1 = _evenly(points0), _evenly(points1)
    poses = [
        (rotation, sign * translation.ravel())
        for rotation in (rotation0, rotation1)
        for sign in (1, -1)
    ]
    return max(poses, key=lambda pose: _cheirality_ratio(points0, points1, calibration, pose))


def _cheirality_ratio(
    points0: np.ndarray, points1: np.ndarray, calibration: Calibration, pose: Pose
) -> float:
    return float(triangulate(points0, points1, calibration, *pose).cheirality.mean())


def _evenly(rows: np.ndarray) -> np.ndarray:
    return rows[:: max(1, -(-len(rows) // MAX_MATCHES))]
