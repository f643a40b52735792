"""Sums and means over the values of nearby pixels, of which only some have a value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .._shared.opencv import cv2


def window_sums(
    pixels: np.ndarray,
    values: np.ndarray | np.generic | float,
    shape: Sequence[int],
    window_px: int,
    *,
    at: np.ndarray | None = None,
    dtype: type[np.floating[Any]] | None = None,
) -> np.ndarray:
    """Sum the values of the pixels in the square window around each pixel.

    Args:
        pixels: (N, 2) int64 pixels (x, y), each once.
        values: (N,) a value for each, or one for all.
        shape: (H, W, ...) of the image.
        window_px: side of the window, odd.
        at: (M, 2) int64 centres of the windows; None: the pixels themselves.
        dtype: of the sums; None: that of the values.

    Returns:
        (M,) sums, 0 where there is no pixel in the window.

    Example:
        >>> pixels = np.array([[0, 0], [2, 1], [9, 9]])
        >>> window_sums(pixels, np.array([1.0, 2, 3]), (10, 10), 5).tolist()
        [3.0, 3.0, 3.0]
    """
    image = _scatter(pixels, values, shape, dtype)
    window = (window_px, window_px)
    sums = cv2.boxFilter(image, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    x, y = (pixels if at is None else at).T
    return sums[y, x]


def gaussian_means(
    pixels: np.ndarray, values: np.ndarray, shape: Sequence[int], sigma_px: float, at: np.ndarray
) -> np.ndarray:
    """Average the values of nearby pixels, weighted by a Gaussian; arguments as `window_sums`.

    Returns:
        (M,) float32 means.
    """
    count, total = (_scatter(pixels, part, shape, np.float32) for part in (1, values))
    count, total = (cv2.GaussianBlur(image, (0, 0), sigma_px) for image in (count, total))
    x, y = at.T
    return (total / np.maximum(count, 1e-6))[y, x]


def _scatter(
    pixels: np.ndarray,
    values: np.ndarray | np.generic | float,
    shape: Sequence[int],
    dtype: type[np.floating[Any]] | None,
) -> np.ndarray:
    """Return an image with the values at their pixels, 0 elsewhere."""
    image = np.zeros(tuple(shape[:2]), dtype or np.asarray(values).dtype)
    image[pixels[:, 1], pixels[:, 0]] = values
    return image
