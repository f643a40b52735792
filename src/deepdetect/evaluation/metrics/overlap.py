"""The part of two images that shows the same."""

from __future__ import annotations

import numpy as np

from ...geometry.residuals import transform_points


def inside(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Tell which points lie in an image.

    Args:
        points: (N, 2) positions, centre of the first pixel (0, 0).
        size: (width, height) in pixels; the image reaches half a pixel beyond the centres of
            its outer pixels.

    Returns:
        (N,) bool; false where a position is not finite.

    Example:
        >>> inside(np.array([[-0.5, 0], [3.4, 0], [3.5, 0]]), (4, 1)).tolist()
        [True, True, False]
    """
    points = np.asarray(points, np.float64).reshape(-1, 2)
    return ((points >= -0.5) & (points < np.asarray(size) - 0.5)).all(1)


def in_front(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Tell which points the second camera has in front of it.

    A homography also maps what lies beyond its horizon, where the plane is not seen, but turns
    it inside out there: its Jacobian's determinant, det(H) / depth^3, is negative.

    Args:
        points: (N, 2) positions.
        homography: (3, 3), of any scale and sign, between two views that are not mirrored.

    Returns:
        (N,) bool.
    """
    depth = np.asarray(points, np.float64).reshape(-1, 2) @ homography[2, :2] + homography[2, 2]
    return depth * np.linalg.det(homography) > 0


def map_into(points: np.ndarray, homography: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Map points into another image; those that it does not show become NaN.

    Args:
        points: (N, 2) positions in one image.
        homography: (3, 3) from that image to the other.
        size: (width, height) of the other image.

    Returns:
        (N, 2) float64.
    """
    mapped = transform_points(points, homography)
    seen = inside(mapped, size) & in_front(points, homography)
    return np.where(seen[:, None], mapped, np.nan)
