"""Triangulation of matches from the pose of two cameras.

Both positions are first moved onto a pair of epipolar lines, as little as possible (Lindstrom,
"Triangulation made easy", 2010, algorithm niter2): this is the maximum likelihood for errors of
the same size in both images. The rays then meet, and the depth is a quotient. Unlike a linear
system of equations this is accurate at small angles, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .camera import Calibration

BLOCK = 100_000
"""Matches that are triangulated at once: a score of arrays of millions would fill the memory."""


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated points.

    Attributes:
        points: (N, 3) float64 in the frame of the first camera: x right, y down, z forward, in
            units of the translation's length. Not finite where the rays are parallel.
        cheirality: (N,) bool, whether the point lies in front of both cameras.
        reprojection_errors: (N,) float64 distances of the matched positions from the projected
            point, in pixels: the root mean square of both images.
        triangulation_angle: (N,) float64 angle between both rays in radians.
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
    """Triangulate matches.

    Args:
        points0, points1: (N, 2) matched positions in pixels.
        calibration: of both cameras.
        rotation, translation: (3, 3) and (3,): a point X of the first camera's frame is
            rotation @ X + translation in the second's.

    Example:
        >>> from .camera import Camera
        >>> camera = Camera((640, 480), 500.0)
        >>> pose = np.eye(3), np.array([-1.0, 0, 0])
        >>> found = triangulate([[319.5, 239.5]], [[269.5, 239.5]], Calibration(camera, camera),
        ...                     *pose)
        >>> found.points.round(6).tolist()
        [[0.0, 0.0, 10.0]]
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    rotation = np.asarray(rotation, np.float64)
    translation = np.asarray(translation, np.float64).reshape(3)
    blocks = [
        _triangulate_block(
            points0[start : start + BLOCK],
            points1[start : start + BLOCK],
            calibration,
            rotation,
            translation,
        )
        for start in range(0, max(len(points0), 1), BLOCK)
    ]
    return Triangulation(*(np.concatenate(values) for values in zip(*blocks, strict=True)))


def _triangulate_block(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Triangulate some matches: the fields of `Triangulation`."""
    fundamental = fundamental_matrix(calibration, rotation, translation)
    moved0, moved1 = correct_matches(points0, points1, fundamental)
    camera0, camera1 = calibration.camera0, calibration.camera1
    rays0 = camera0.rays(moved0)
    rays1 = camera1.rays(moved1)
    rotated = rays0 @ rotation.T
    # ray1 x (depth * rotated + translation) = 0
    normals = np.cross(rays1, rotated)
    squares = np.einsum("ij,ij->i", normals, normals)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -np.einsum("ij,ij->i", normals, np.cross(rays1, translation)) / squares
        points = rays0 * depth[:, None]
    depth1 = (points @ rotation.T + translation)[:, 2]
    cheirality = np.isfinite(depth) & (depth > 0) & (depth1 > 0)
    error = ((moved0 - points0) ** 2).sum(1) + ((moved1 - points1) ** 2).sum(1)
    angle = np.arctan2(np.sqrt(squares), np.einsum("ij,ij->i", rays1, rotated))
    return points, cheirality, np.sqrt(error / 2), angle


def fundamental_matrix(
    calibration: Calibration, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """Return the fundamental matrix of two cameras in pixels, (3, 3) with x1^T F x0 = 0."""
    essential = cross_matrix(translation) @ rotation
    inverse0 = np.linalg.inv(calibration.camera0.matrix)
    return np.linalg.inv(calibration.camera1.matrix).T @ essential @ inverse0


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Return the (3, 3) matrix M with M @ v = vector x v."""
    x, y, z = np.asarray(vector, np.float64).reshape(3)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def correct_matches(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move matches as little as possible so that x1^T F x0 = 0 holds (Lindstrom 2010, niter2).

    Args:
        points0, points1: (N, 2) matched positions.
        fundamental: (3, 3) with x1^T F x0 = 0.

    Returns:
        (N, 2) and (N, 2) moved positions.
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
        step = c / (b + np.sqrt(np.maximum(b * b - a * c, 0)))
        next0 = normal0 - step[:, None] * (normal1 @ block)
        next1 = normal1 - step[:, None] * (normal0 @ block.T)
        step = step * 2 * b / ((next0**2).sum(1) + (next1**2).sum(1))
        moved0 = points0 - step[:, None] * next0
        moved1 = points1 - step[:, None] * next1
    # On an epipole every line is right: such a match stays where it is.
    known = np.isfinite(moved0).all(1) & np.isfinite(moved1).all(1)
    return np.where(known[:, None], moved0, points0), np.where(known[:, None], moved1, points1)
