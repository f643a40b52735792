"""Downscaled images, and geometries at other scales."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2

ANTIALIASING_SIGMA = 0.5
"""Of the blur before an image is downscaled, in units of sqrt(1 / scale^2 - 1) pixels."""


def downscale(gray: np.ndarray, max_side: int) -> tuple[np.ndarray, float]:
    """Downscale an image whose longer side has more than `max_side` pixels to this size.

    Returns:
        The image, and its scale: at most 1.
    """
    scale = min(1.0, max_side / max(gray.shape))
    if scale == 1:
        return gray, 1.0
    # The sides are seldom whole numbers of pixels: blur and sample by the scale itself, so that
    # one number holds for both.
    size = (max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale)))
    smooth = cv2.GaussianBlur(gray, (0, 0), ANTIALIASING_SIGMA * np.sqrt(1 / scale**2 - 1))
    affine = _scaling(scale)[:2]
    return cv2.warpAffine(smooth, affine, size, borderMode=cv2.BORDER_REPLICATE), scale


def scaled_points(points: np.ndarray, scale: float) -> np.ndarray:
    """Return positions in an image of another scale; pixel centres are whole numbers.

    Example:
        >>> scaled_points(np.array([[0.0, 1.0]]), 2).tolist()
        [[0.5, 2.5]]
    """
    return (np.asarray(points, np.float64) + 0.5) * scale - 0.5


def scaled_homography(homography: np.ndarray, scale0: float, scale1: float) -> np.ndarray:
    """Return the homography between both images at other scales, its last element 1."""
    matrix = _scaling(scale1) @ homography @ _scaling(1 / scale0)
    return matrix / matrix[2, 2]


def scaled_fundamental(fundamental: np.ndarray, scale0: float, scale1: float) -> np.ndarray:
    """Return the fundamental matrix between both images at other scales."""
    return _scaling(1 / scale1).T @ fundamental @ _scaling(1 / scale0)


def _scaling(scale: float) -> np.ndarray:
    """Return the (3, 3) map from an image to the same image at another scale."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
