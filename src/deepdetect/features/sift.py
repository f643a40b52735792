"""SIFT descriptors at given keypoints, all of one size and one angle (paper, Section III-C)."""

from __future__ import annotations

import cv2
import numpy as np

from .dense_sift import SIZES, dense_sift, on_pixels, root

DENSE = 0.02
"""Keypoints a pixel from which all at once (`dense_sift`) takes less time than one by one."""


def sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute SIFT descriptors, in the way that is fastest for these keypoints.

    Many upright keypoints on whole pixels are done all at once, which differs from OpenCV's
    numbers by 1 in one of ten thousand; others by OpenCV.

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        size: diameter of the keypoint in pixels.
        angle: its direction in degrees; 0 is upright. -1 is OpenCV's "unset", which its
            SIFT takes for a turn of one degree; the published code leaves it so.

    Returns:
        (N, 128) uint8.

    Example:
        >>> sift_descriptors(np.zeros((32, 32), np.uint8), np.array([[8, 8]])).shape
        (1, 128)
    """
    many = len(xy) > DENSE * gray.size
    if many and angle == 0 and SIZES[0] <= size <= SIZES[1] and on_pixels(xy, gray.shape):
        return dense_sift(gray, xy, size)
    return opencv_sift_descriptors(gray, xy, size, angle)


def opencv_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute OpenCV's SIFT descriptors; arguments and result as of `sift_descriptors`."""
    if not len(xy):
        return np.empty((0, 128), np.uint8)
    keypoints = cv2.KeyPoint_convert(np.asarray(xy, np.float32), size=size)
    if angle != -1:
        for keypoint in keypoints:
            keypoint.angle = angle
    described, descriptors = cv2.SIFT_create().compute(gray, keypoints)
    if len(described) != len(xy):  # it would break the rows' order without a word
        raise AssertionError("cv2.SIFT left out keypoints that were given to it")
    return descriptors.astype(np.uint8)  # they are whole numbers from 0 to 255


def root_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute RootSIFT, the root of L1-normalised SIFT, as whole numbers (`dense_sift.root`)."""
    return root(sift_descriptors(gray, xy, size, angle), overwrite=True)
