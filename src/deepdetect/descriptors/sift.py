"""SIFT descriptors at given keypoints, all of one size and one angle (paper, Section III-C)."""

from __future__ import annotations

import cv2
import numpy as np


def sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute OpenCV's SIFT descriptors.

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        size: diameter of the keypoint in pixels.
        angle: its direction in degrees; 0 is upright. -1 is OpenCV's "unset", which its
            SIFT takes for a turn of one degree; the published code leaves it so.

    Returns:
        (N, 128) float32, whole numbers from 0 to 255.

    Example:
        >>> sift_descriptors(np.zeros((32, 32), np.uint8), np.array([[8, 8]])).shape
        (1, 128)
    """
    if not len(xy):
        return np.empty((0, 128), np.float32)
    keypoints = cv2.KeyPoint_convert(np.asarray(xy, np.float32), size=size)
    if angle != -1:
        for keypoint in keypoints:
            keypoint.angle = angle
    described, descriptors = cv2.SIFT_create().compute(gray, keypoints)
    if len(described) != len(xy):  # it would break the rows' order without a word
        raise AssertionError("cv2.SIFT left out keypoints that were given to it")
    return descriptors


def root_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute RootSIFT: the square root of L1-normalised SIFT (Arandjelovic, 2012).

    Its Euclidean distance is the Hellinger distance of SIFT.

    Returns:
        (N, 128) float32 of unit length (0 where SIFT is 0).
    """
    descriptors = sift_descriptors(gray, xy, size, angle)
    total = descriptors.sum(1, keepdims=True)
    return np.sqrt(descriptors / np.maximum(total, 1))
