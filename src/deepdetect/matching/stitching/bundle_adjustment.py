"""Bundle adjustment of all images of a panorama: of homographies, or of cameras that only turned.

Gauss-Newton with Huber's weights. What counts is how far a point that is taken to the common frame
and back into its partner image comes from where it belongs there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.camera import Camera, Size
from ...geometry.transforms import transform_points

MAX_ITERATIONS, MIN_STEP = 20, 1e-7
"""The fit ends after this many iterations, or with a smaller change of the parameters."""

UNIT_PX = 500.0
"""Unit of length of the fit, so that all entries of a homography are of one order."""

HUBER_THRESHOLD_PX = 2.0
"""Larger residuals have less weight."""

FOCAL_LENGTHS = np.geomspace(0.3, 10, 100) * 640 / UNIT_PX
"""Where the search for the focal length starts, in units: 0.3 to 10 times the longer side."""

FOCAL_WEIGHT = 1e-4
"""Of a focal length's distance from the common one: half a pixel of noise per tenth of its size."""

Matrices = Mapping[int, np.ndarray]
"""By the number of the image."""

Sizes = Mapping[int, tuple[int, int]]
"""(width, height) of the images, by number."""

Links = list[tuple[int, int, np.ndarray, np.ndarray]]
"""Numbers of two images, and (M, 2) points of both that are the same, in units."""


@dataclass(frozen=True, eq=False)
class RegisteredPair:
    """Two images, by their numbers, related by a homography that dense keypoints confirm.

    `points` are some of the first image's keypoints with a match, of so many `matches`.
    """

    first: int
    second: int
    homography: np.ndarray
    points: np.ndarray
    matches: int


@dataclass(frozen=True, eq=False)
class RotatingCamera:
    """A camera that only turned, with its principal point in the middle of the image.

    The rotation goes from the camera to the common frame: x right, y down, z forward.
    """

    focal_px: float
    rotation: np.ndarray

    def to_common(self, size: Size) -> np.ndarray:
        """Return the (3, 3) map from pixels of its image to directions in the common frame."""
        return np.asarray(self.rotation @ np.linalg.inv(Camera(size, self.focal_px).matrix))


Cameras = Mapping[int, RotatingCamera]


def adjust_homographies(
    homographies: Matrices, pairs: Sequence[RegisteredPair], sizes: Sizes
) -> tuple[dict[int, np.ndarray], float]:
    """Fit all homographies but the first, which stays, to all pairs at once.

    `homographies` go from each image to the frame of the first one, near enough; `sizes` are
    (width, height). Returns the root mean square of the residuals in pixels, too.
    """
    to_unit, current, links = _in_units(homographies, pairs, sizes)
    reference, *moving = homographies
    columns = {number: 8 * k for k, number in enumerate(moving)}
    directions = dict.fromkeys(moving, np.eye(9)[:, :8])
    for _ in range(MAX_ITERATIONS):
        normal, right = _normal_equations(current, links, columns, directions)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        for number, column in columns.items():  # H (I + E), with the last element of E 0
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
    """Fit rotations and focal lengths of all cameras; else as `adjust_homographies`."""
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
        step = np.linalg.lstsq(normal, right, rcond=None)[0]  # all may turn together
        for number, column in columns.items():
            rotations[number] = rotations[number] @ cv2.Rodrigues(step[column : column + 3])[0]
            focals[number] *= float(np.exp(step[column + 3]))
        if np.abs(step).max() < MIN_STEP:
            break
    current = {n: rotations[n] @ np.diag([1 / f, 1 / f, 1]) for n, f in focals.items()}
    cameras = {n: RotatingCamera(UNIT_PX * focals[n], rotations[n]) for n in rotations}
    return cameras, _residual_px(current, links)


def level_cameras(cameras: Cameras, reference: int) -> dict[int, RotatingCamera]:
    """Turn all cameras together, so that the horizon is level and the reference in the middle.

    The horizon is what the rows of all images are parallel to (Brown and Lowe, "Automatic panoramic
    image stitching using invariant features", 2007), and where they leave it open, upright to the
    mean of the columns.
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
    """Return the maps of pixels to units, 0 in the middle; and homographies and links in units."""
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
        # The homography is sharper than keypoints on whole pixels.
        targets = transform_points(pair.points, pair.homography)
        points = transform_points(pair.points, to_unit[pair.first])
        targets = transform_points(targets, to_unit[pair.second])
        links.append((pair.first, pair.second, points, targets))
    return to_unit, current, links


def _normal_equations(
    current: Matrices, links: Links, columns: Mapping[int, int], directions: Matrices
) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides of the normal equations.

    `columns` says where the parameters of an image begin; their (9, P) `directions` what a
    parameter adds to E of H (I + E).
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
    """Return residuals in the second image (M, 2) and their derivatives by both E (M, 2, 9)."""
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
    """Return the rotations nearest to homographies in units, and how far these are from them."""
    rotations, misfit = {}, 0.0
    for number, matrix in homographies.items():
        left, stretch, right = np.linalg.svd(
            np.diag([1 / focal, 1 / focal, 1]) @ matrix @ np.diag([focal, focal, 1])
        )
        rotations[number] = left @ right
        misfit += float(((stretch - 1) ** 2).sum())
    return rotations, misfit


def _turns_and_focal(focal: float) -> np.ndarray:
    """Return the (9, 4) derivatives of E by turns about x, y and z, and by the log focal length."""
    turns = np.zeros((4, 3, 3))
    turns[0, 1, 2], turns[0, 2, 1] = -focal, 1 / focal
    turns[1, 0, 2], turns[1, 2, 0] = focal, -1 / focal
    turns[2, 0, 1], turns[2, 1, 0] = -1, 1
    turns[3] = np.diag([-1, -1, 0])
    return turns.reshape(4, 9).T


def _unit_determinant(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.cbrt(np.linalg.det(matrix))
