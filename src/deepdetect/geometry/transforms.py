"""Apply homographies and fundamental matrices to points, and measure errors of matches."""

from __future__ import annotations

import numpy as np


def transform_points(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Map points by a homography.

    Args:
        points: (N, 2) positions; the centre of the first pixel is (0, 0).
        homography: (3, 3) matrix that multiplies columns (x, y, 1).

    Returns:
        (N, 2) float64 positions; infinite for points that are mapped to infinity.

    Example:
        >>> transform_points([[1, 2]], np.diag([2, 2, 1])).tolist()
        [[2.0, 4.0]]
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    *mapped, depth = _apply(homography, points)
    result = np.empty_like(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis, values in enumerate(mapped):
            np.divide(values, depth, out=result[:, axis])
    result[depth == 0] = np.inf
    return result


def transfer_errors(points0: np.ndarray, points1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return the transfer error of each match under a homography, (N,) float64 in pixels.

    The error is one-way, as in the DeepDetect paper: the distance, in the second image, between the
    mapped first position and the matched position.
    """
    gaps = transform_points(points0, homography)
    gaps -= points1
    return np.sqrt(np.einsum("ij,ij->i", gaps, gaps))


def epipolar_errors(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Return the Sampson distance of each match under a fundamental matrix, in pixels.

    Args:
        points0, points1: (N, 2) matched positions.
        fundamental: (3, 3) matrix F for which correct matches fulfil x1^T F x0 = 0.

    Returns:
        (N,) float64 distances.
    """
    return np.abs(signed_epipolar_errors(points0, points1, fundamental))


def signed_epipolar_errors(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Return `epipolar_errors` with a sign: the side of the epipolar line on which a match lies."""
    points0, points1 = np.asarray(points0, np.float64), np.asarray(points1, np.float64)
    across1, down1, algebraic = _apply(fundamental, points0)
    across0, down0 = _apply(fundamental.T[:2], points1)
    algebraic += across1 * points1[:, 0]
    algebraic += down1 * points1[:, 1]
    gradient = across1 * across1
    for part in (down1, across0, down0):
        part *= part
        gradient += part
    algebraic /= np.sqrt(np.maximum(gradient, 1e-300))
    return algebraic


def epipolar_slopes(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Return the (N, 9) derivatives of `signed_epipolar_errors` by the matrix, row by row."""
    first, second = (np.column_stack([p, np.ones(len(p))]) for p in (points0, points1))
    lines1, lines0 = first @ fundamental.T, second @ fundamental
    algebraic = (second * lines1).sum(axis=1)
    lines1[:, 2] = lines0[:, 2] = 0
    squared = np.maximum((lines1**2 + lines0**2).sum(axis=1), 1e-300)[:, None]
    # The derivative of a / sqrt(g), where a is x1^T F x0, and g the squared length of its gradient.
    products = [
        a[:, :, None] * b[:, None] for a, b in ((second, first), (lines1, first), (second, lines0))
    ]
    outer, of_lines = products[0].reshape(-1, 9), (products[1] + products[2]).reshape(-1, 9)
    return np.asarray((outer - (algebraic[:, None] / squared) * of_lines) / np.sqrt(squared))


def _apply(matrix: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Multiply points (x, y, 1) by each row of a matrix; this is faster than a matrix product."""
    x, y = points[:, 0], points[:, 1]
    coordinates = []
    for row in matrix:
        values = row[0] * x
        values += row[1] * y
        values += row[2]
        coordinates.append(values)
    return coordinates


TOLERANCE_PX = 1.0
"""A match is correct within this distance of the ground truth, as in Middlebury's evaluation."""


def disparity_errors(points0: np.ndarray, points1: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Return how far the matches of a rectified pair lie from their true positions.

    Args:
        points0: (N, 2) positions in the left image; the disparity is read at the nearest pixel.
        points1: (N, 2) matched positions in the right image.
        disparity: (H, W) ground-truth disparity d of the left image in pixels: the true match of
            (x, y) is (x - d, y). It is not finite where it is unknown.

    Returns:
        (N,) float64 distances in pixels, NaN where the true disparity is unknown.
    """
    points0 = np.asarray(points0, np.float64)
    column, row = np.rint(points0).astype(int).T
    true = np.where(np.isfinite(disparity), disparity, np.nan)[row, column]
    expected = np.column_stack([points0[:, 0] - true, points0[:, 1]])
    return np.linalg.norm(expected - points1, axis=1)


def score_errors(errors: np.ndarray) -> dict[str, float]:
    """Score the (N,) errors from `disparity_errors`, which are NaN without ground truth.

    Returns the number of all "matches", of "evaluated" matches (with known ground truth), and of
    "correct" matches (within `TOLERANCE_PX`), and the "precision": correct / evaluated.
    """
    evaluated = int(np.isfinite(errors).sum())
    correct = int((errors <= TOLERANCE_PX).sum())
    counts = {"matches": len(errors), "evaluated": evaluated, "correct": correct}
    return counts | {"precision": correct / evaluated if evaluated else 0.0}


def homography_derivatives(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return the (N, 2, 2) derivatives of a homography at (N, 2) points."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    depth = mapped[:, 2, None, None]
    by_depth = mapped[:, :2, None] * homography[2, :2]
    return np.asarray(homography[:2, :2] / depth - by_depth / depth**2)


def translation_matrix(x: float, y: float) -> np.ndarray:
    """Return the (3, 3) homography that moves positions by (x, y)."""
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def outer_corners(size: tuple[int, int]) -> np.ndarray:
    """Return the (4, 2) outer corners of an image, half a pixel beyond the outermost centres."""
    width, height = size
    return np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5


def scaling_matrix(scale: float) -> np.ndarray:
    """Return the (3, 3) homography from an image to a copy of it that is `scale` times as large."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])


def scaled_points(points: np.ndarray, scale: float) -> np.ndarray:
    """Map positions to a copy of the image at `scale`; pixel centres are whole numbers in both."""
    return (np.asarray(points, np.float64) + 0.5) * scale - 0.5


def scaled_homography(homography: np.ndarray, scale0: float, scale1: float) -> np.ndarray:
    """Return the homography between scaled copies of two images; its last element is 1."""
    matrix = scaling_matrix(scale1) @ homography @ scaling_matrix(1 / scale0)
    return matrix / matrix[2, 2]


def scaled_fundamental(fundamental: np.ndarray, scale0: float, scale1: float) -> np.ndarray:
    """Return the fundamental matrix of copies of both images, scaled by `scale0` and `scale1`."""
    return scaling_matrix(1 / scale1).T @ fundamental @ scaling_matrix(1 / scale0)
