"""Bundle adjustment of a panorama: homographies, or rotations and focal lengths of cameras.

The fit uses Gauss-Newton with Huber weights. A residual is the distance between a match in the
second image and its partner, mapped from the first image to the common frame and on to the second
image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.camera import Camera, Size
from ...geometry.transforms import transform_points

MAX_ITERATIONS, MIN_STEP = 20, 1e-7
"""The fit ends after MAX_ITERATIONS, or earlier if no parameter changes by more than MIN_STEP."""

UNIT_PX = 500.0
"""Unit of length in the fit, chosen so that all entries of a homography have similar magnitudes."""

HUBER_THRESHOLD_PX = 2.0
"""Huber's loss reduces the weight of residuals above this. Chosen by hand; not measured."""

FOCAL_LENGTHS = np.geomspace(0.3, 10, 100) * 640 / UNIT_PX
"""Start values of the focal length in units of the fit: 0.3 to 10 times 640 px, the default longer
side of the images for registration."""

FOCAL_WEIGHT = 1e-4
"""Weight of the term that keeps all focal lengths equal: a camera whose focal length is off by 10 %
costs as much as a match with a residual of 0.5 px."""

Matrices = Mapping[int, np.ndarray]
"""A (3, 3) matrix for each image number."""

Sizes = Mapping[int, tuple[int, int]]
"""(width, height) for each image number."""

Links = list[tuple[int, int, np.ndarray, np.ndarray]]
"""The registered pairs, each as the numbers of both images and the corresponding points, (M, 2) in
each image, in units of the fit."""


@dataclass(frozen=True, eq=False)
class RegisteredPair:
    """The numbers of two images, and the homography between them that dense keypoints confirm.

    `points`, (M, 2), are matched keypoints of the first image: all, or some if there are many.
    `matches` is the number of all matches.
    """

    first: int
    second: int
    homography: np.ndarray
    points: np.ndarray
    matches: int


@dataclass(frozen=True, eq=False)
class RotatingCamera:
    """A camera that only rotates, with its principal point at the image centre.

    The rotation maps camera coordinates to the common frame: x right, y down, z forward.
    """

    focal_px: float
    rotation: np.ndarray

    def to_common(self, size: Size) -> np.ndarray:
        """Return the (3, 3) map from image pixels to directions in the common frame."""
        return np.asarray(self.rotation @ np.linalg.inv(Camera(size, self.focal_px).matrix))


Cameras = Mapping[int, RotatingCamera]


def adjust_homographies(
    homographies: Matrices, pairs: Sequence[RegisteredPair], sizes: Sizes
) -> tuple[dict[int, np.ndarray], float]:
    """Fit all homographies jointly to all pairs; the first one stays fixed.

    `homographies` are start values, which map each image to the frame of the first. Also returns
    the root mean square of the residuals in pixels.
    """
    to_unit, current, links = _in_units(homographies, pairs, sizes)
    reference, *moving = homographies
    columns = {number: 8 * k for k, number in enumerate(moving)}
    directions = dict.fromkeys(moving, np.eye(9)[:, :8])
    for _ in range(MAX_ITERATIONS):
        normal, right = _normal_equations(current, links, columns, directions)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        for number, column in columns.items():  # H becomes H (I + E); E[2, 2] = 0 fixes the scale
            change = np.append(step[column : column + 8], 0).reshape(3, 3)
            current[number] = _unit_determinant(current[number] @ (np.eye(3) + change))
        if np.abs(step).max(initial=0) < MIN_STEP:
            break
    refined = {
        number: np.linalg.inv(to_unit[reference]) @ matrix @ to_unit[number]
        for number, matrix in current.items()
    }
    return refined, _residual_px(current, links)


def adjust_cameras(
    homographies: Matrices, pairs: Sequence[RegisteredPair], sizes: Sizes
) -> tuple[dict[int, RotatingCamera], float]:
    """Fit rotations and focal lengths of all cameras, otherwise like `adjust_homographies`."""
    _, to_first, links = _in_units(homographies, pairs, sizes)
    starts = [_rotations(to_first, focal) for focal in FOCAL_LENGTHS]
    best = int(np.argmin([misfit for _, misfit in starts]))
    rotations, common = starts[best][0], float(FOCAL_LENGTHS[best])
    focals = dict.fromkeys(rotations, common)
    columns = {number: 4 * k for k, number in enumerate(rotations)}
    for _ in range(MAX_ITERATIONS):
        current = {n: rotations[n] @ np.diag([1 / f, 1 / f, 1]) for n, f in focals.items()}
        directions = {number: _turns_and_focal(focal) for number, focal in focals.items()}
        normal, right = _normal_equations(current, links, columns, directions)
        for number, column in columns.items():
            normal[column + 3, column + 3] += FOCAL_WEIGHT
            right[column + 3] -= FOCAL_WEIGHT * np.log(focals[number] / common)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]  # singular: all may rotate together
        for number, column in columns.items():
            rotations[number] = rotations[number] @ cv2.Rodrigues(step[column : column + 3])[0]
            focals[number] *= float(np.exp(step[column + 3]))
        if np.abs(step).max() < MIN_STEP:
            break
    current = {n: rotations[n] @ np.diag([1 / f, 1 / f, 1]) for n, f in focals.items()}
    cameras = {n: RotatingCamera(UNIT_PX * focals[n], rotations[n]) for n in rotations}
    return cameras, _residual_px(current, links)


def level_cameras(cameras: Cameras, reference: int) -> dict[int, RotatingCamera]:
    """Rotate all cameras together so that the horizon is level and the reference is in the middle.

    The horizon is the plane to which the rows of all images are nearly parallel (Brown and Lowe,
    "Automatic panoramic image stitching using invariant features", 2007). If the rows do not
    determine this plane, it is the one perpendicular to the mean direction of the columns.
    """
    across = np.array([camera.rotation[:, 0] for camera in cameras.values()])
    down = np.mean([camera.rotation[:, 1] for camera in cameras.values()], axis=0)
    y = np.linalg.solve(across.T @ across / len(across) + 1e-3 * np.eye(3), down)
    y /= np.linalg.norm(y)
    ahead = cameras[reference].rotation[:, 2]
    z = ahead - ahead @ y * y
    z /= np.linalg.norm(z)
    level = np.stack([np.cross(y, z), y, z])
    return {n: RotatingCamera(one.focal_px, level @ one.rotation) for n, one in cameras.items()}


def _in_units(
    homographies: Matrices, pairs: Sequence[RegisteredPair], sizes: Sizes
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray], Links]:
    """Return maps from pixels to units of the fit, and homographies and links in these units."""
    to_unit = {}
    for number in homographies:
        x, y = (np.array(sizes[number]) - 1) / (2 * UNIT_PX)
        to_unit[number] = np.array([[1 / UNIT_PX, 0, -x], [0, 1 / UNIT_PX, -y], [0, 0, 1]])
    frame = to_unit[next(iter(homographies))]
    current = {
        number: _unit_determinant(frame @ matrix @ np.linalg.inv(to_unit[number]))
        for number, matrix in homographies.items()
    }
    links = []
    for pair in pairs:
        # The targets come from the homography, which is more accurate than integer keypoints.
        targets = transform_points(pair.points, pair.homography)
        points = transform_points(pair.points, to_unit[pair.first])
        targets = transform_points(targets, to_unit[pair.second])
        links.append((pair.first, pair.second, points, targets))
    return to_unit, current, links


def _normal_equations(
    current: Matrices, links: Links, columns: Mapping[int, int], directions: Matrices
) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides of the normal equations.

    A step changes each homography H to H (I + E). `directions` gives the (9, P) derivatives of E
    with respect to the P parameters of each image, and `columns` the index of the first parameter
    of each image that is not fixed.
    """
    count = sum(matrix.shape[1] for matrix in directions.values())
    normal, right = np.zeros((count, count)), np.zeros(count)
    for first, second, points, targets in links:
        residuals, *jacobians = _linearised(current[first], current[second], points, targets)
        distances = UNIT_PX * np.linalg.norm(residuals, axis=1)
        weights = np.minimum(1, HUBER_THRESHOLD_PX / np.maximum(distances, 1e-12))
        blocks = [
            (columns[number], jacobian @ directions[number])
            for number, jacobian in zip((first, second), jacobians, strict=True)
            if number in columns
        ]
        for row, jacobian in blocks:
            weighted = jacobian * weights[:, None, None]
            rows = slice(row, row + jacobian.shape[2])
            right[rows] -= np.einsum("mai,ma->i", weighted, residuals)
            for start, other in blocks:
                columns_of_other = slice(start, start + other.shape[2])
                normal[rows, columns_of_other] += np.einsum("mai,maj->ij", weighted, other)
    return normal, right


def _linearised(
    first: np.ndarray, second: np.ndarray, points: np.ndarray, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (M, 2) residuals in the second image, and their (M, 2, 9) derivatives for each image.

    The derivatives are with respect to E: a step changes a homography H to H (I + E).
    """
    between = np.linalg.inv(second) @ first
    homogeneous = np.column_stack([points, np.ones(len(points))])
    mapped = homogeneous @ between.T
    x, y, w = mapped.T
    zero = np.zeros_like(w)
    rows = [[1 / w, zero, -x / w**2], [zero, 1 / w, -y / w**2]]
    projection = np.stack([np.stack(row, axis=1) for row in rows], axis=1)
    by_first = np.einsum("mka,mb->mkab", projection @ between, homogeneous)
    by_second = -np.einsum("mka,mb->mkab", projection, mapped)
    shape = (len(points), 2, 9)
    residuals = mapped[:, :2] / w[:, None] - targets
    return residuals, by_first.reshape(shape), by_second.reshape(shape)


def _residual_px(current: Matrices, links: Links) -> float:
    residuals = [
        _linearised(current[first], current[second], points, targets)[0]
        for first, second, points, targets in links
    ]
    return float(UNIT_PX * np.sqrt((np.concatenate(residuals) ** 2).sum(1).mean()))


def _rotations(homographies: Matrices, focal: float) -> tuple[dict[int, np.ndarray], float]:
    """Return the rotations nearest to homographies in units of the fit, and the squared misfit."""
    rotations, misfit = {}, 0.0
    for number, matrix in homographies.items():
        left, stretch, right = np.linalg.svd(
            np.diag([1 / focal, 1 / focal, 1]) @ matrix @ np.diag([focal, focal, 1])
        )
        rotations[number] = left @ right
        misfit += float(((stretch - 1) ** 2).sum())
    return rotations, misfit


def _turns_and_focal(focal: float) -> np.ndarray:
    """Return E's (9, 4) derivatives, in H (I + E), by three rotations and the log focal length."""
    turns = np.zeros((4, 3, 3))
    turns[0, 1, 2], turns[0, 2, 1] = -focal, 1 / focal
    turns[1, 0, 2], turns[1, 2, 0] = focal, -1 / focal
    turns[2, 0, 1], turns[2, 1, 0] = -1, 1
    turns[3] = np.diag([-1, -1, 0])
    return turns.reshape(4, 9).T


def _unit_determinant(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.cbrt(np.linalg.det(matrix))
