"""One fit of the homographies of many images to all their pairs: Gauss-Newton, Huber's weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.residuals import transform_points
from .options import DEFAULTS

MAX_ITERATIONS = 20
MIN_STEP = 1e-7
"""The fit ends after this many iterations, or with a smaller change of the homographies."""

UNIT_PX = 500.0
"""Unit of length of the fit, so that all entries of a homography are of one order."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of two images that belong together.

    Attributes:
        first, second: numbers of the images.
        points, targets: (M, 2) in pixels of the first and of the second.
    """

    first: int
    second: int
    points: np.ndarray
    targets: np.ndarray


def fit_jointly(
    homographies: Mapping[int, np.ndarray],
    pairs: Sequence[Correspondences],
    sizes: Mapping[int, tuple[int, int]],
    *,
    huber_threshold_px: float = DEFAULTS.huber_threshold_px,
) -> tuple[dict[int, np.ndarray], float]:
    """Fit all homographies but the first, which stays, to all pairs at once.

    What counts is how far a point that is taken to the common frame and back into its partner image
    comes from where it belongs there.

    Args:
        homographies: (3, 3) from each image to the frame of the first one, by number, near enough.
        pairs: what belongs together.
        sizes: (width, height) of the images.
        huber_threshold_px: larger residuals have less weight.

    Returns:
        The homographies, and the root mean square of the residuals in pixels.

    Example:
        >>> grid = np.argwhere(np.ones((5, 5))) * 20.0
        >>> pair = Correspondences(0, 1, grid, grid - [30, 0])
        >>> start = {0: np.eye(3), 1: np.array([[1, 0, 25.0], [0, 1, 3], [0, 0, 1]])}
        >>> found, residual_px = fit_jointly(start, [pair], {0: (100, 100), 1: (100, 100)})
        >>> (found[1] / found[1][2, 2])[:2, 2].round(3).tolist(), round(residual_px, 3)
        ([30.0, 0.0], 0.0)
    """
    to_unit = {number: _to_unit(sizes[number]) for number in homographies}
    reference, *moving = homographies
    current = {
        number: _unit_determinant(to_unit[reference] @ matrix @ np.linalg.inv(to_unit[number]))
        for number, matrix in homographies.items()
    }
    column = {number: 8 * k for k, number in enumerate(moving)}
    samples = [
        (
            transform_points(pair.points, to_unit[pair.first]),
            transform_points(pair.targets, to_unit[pair.second]),
        )
        for pair in pairs
    ]
    for _ in range(MAX_ITERATIONS):
        normal, right = np.zeros((8 * len(moving),) * 2), np.zeros(8 * len(moving))
        for pair, (points, targets) in zip(pairs, samples, strict=True):
            residuals, *jacobians = _linearised(
                current[pair.first], current[pair.second], points, targets
            )
            distances = UNIT_PX * np.linalg.norm(residuals, axis=1)
            weights = np.minimum(1, huber_threshold_px / np.maximum(distances, 1e-12))
            blocks = [
                (column[number], jacobian)
                for number, jacobian in zip((pair.first, pair.second), jacobians, strict=True)
                if number != reference
            ]
            for row, jacobian in blocks:
                weighted = jacobian * weights[:, None, None]
                right[row : row + 8] -= np.einsum("mai,ma->i", weighted, residuals)
                for start, other in blocks:
                    normal[row : row + 8, start : start + 8] += np.einsum(
                        "mai,maj->ij", weighted, other
                    )
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        for number in moving:  # H (I + E), with the last element of E 0
            change = np.append(step[column[number] : column[number] + 8], 0).reshape(3, 3)
            current[number] = _unit_determinant(current[number] @ (np.eye(3) + change))
        if np.abs(step).max(initial=0) < MIN_STEP:
            break
    left = [
        _linearised(current[pair.first], current[pair.second], *sample)[0]
        for pair, sample in zip(pairs, samples, strict=True)
    ]
    squares = np.concatenate([(values**2).sum(1) for values in left])
    refined = {
        number: np.linalg.inv(to_unit[reference]) @ matrix @ to_unit[number]
        for number, matrix in current.items()
    }
    return refined, float(UNIT_PX * np.sqrt(squares.mean()))


def _unit_determinant(matrix: np.ndarray) -> np.ndarray:
    return matrix / np.cbrt(np.linalg.det(matrix))


def _to_unit(size: tuple[int, int]) -> np.ndarray:
    """Return the map of pixels to coordinates of the joint fit, 0 in the middle."""
    x, y = (np.array(size) - 1) / (2 * UNIT_PX)
    return np.array([[1 / UNIT_PX, 0, -x], [0, 1 / UNIT_PX, -y], [0, 0, 1]])


def _linearised(
    first: np.ndarray, second: np.ndarray, points: np.ndarray, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals in the second image (M, 2) and their derivatives by both E (M, 2, 8)."""
    between = np.linalg.inv(second) @ first
    homogeneous = np.column_stack([points, np.ones(len(points))])
    mapped = homogeneous @ between.T
    x, y, w = mapped.T
    zero = np.zeros_like(w)
    projection = np.stack(
        [
            np.stack([1 / w, zero, -x / w**2], axis=1),
            np.stack([zero, 1 / w, -y / w**2], axis=1),
        ],
        axis=1,
    )
    by_first = np.einsum("mka,mb->mkab", projection @ between, homogeneous)
    by_second = -np.einsum("mka,mb->mkab", projection, mapped)
    shape = (len(points), 2, 9)
    residuals = mapped[:, :2] / w[:, None] - targets
    return residuals, by_first.reshape(shape)[..., :8], by_second.reshape(shape)[..., :8]
