"""Keypoints of OpenCV's detectors, as pixels of a mask."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np


def empty_mask(gray: np.ndarray) -> np.ndarray:
    """Return an all-False mask of the image's size."""
    return np.zeros(gray.shape[:2], dtype=bool)


def pixels_mask(shape: tuple[int, ...], xy: np.ndarray) -> np.ndarray:
    """Mark the pixel nearest to each point, halves rounded to even.

    Args:
        shape: (height, width) of the mask.
        xy: (N, 2) float points, x right and y down, centre of the first pixel (0, 0).

    Returns:
        (height, width) bool mask. Points outside the image are left out.

    Example:
        >>> pixels_mask((1, 3), np.array([[0.5, 0.0], [1.5, 0.0]])).tolist()
        [[True, False, True]]
    """
    mask = np.zeros(shape[:2], dtype=bool)
    column, row = np.rint(np.asarray(xy, dtype=np.float64).reshape(-1, 2)).astype(np.intp).T
    inside = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
    mask[row[inside], column[inside]] = True
    return mask


def keypoints_mask(gray: np.ndarray, keypoints: Sequence[cv2.KeyPoint]) -> np.ndarray:
    """Mark the pixel of each OpenCV keypoint (see `pixels_mask`)."""
    if not len(keypoints):
        return empty_mask(gray)
    return pixels_mask(gray.shape, cv2.KeyPoint_convert(keypoints))
