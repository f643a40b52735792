"""Shi-Tomasi: corners by the smaller eigenvalue of the gradient covariance (1994)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .points import empty_mask, pixels_mask


@dataclass(frozen=True)
class ShiTomasiSettings:
    """Settings of `cv2.goodFeaturesToTrack`; `corners` 0 means all of them."""

    corners: int = 0
    quality_level: float = 0.01
    minimum_distance: float = 1.0
    block_size: int = 2


def shi_tomasi_mask(gray: np.ndarray, settings: ShiTomasiSettings) -> np.ndarray:
    """Mark the Shi-Tomasi corners of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    corners = cv2.goodFeaturesToTrack(
        gray,
        maxCorners=settings.corners,
        qualityLevel=settings.quality_level,
        minDistance=settings.minimum_distance,
        blockSize=settings.block_size,
    )
    return empty_mask(gray) if corners is None else pixels_mask(gray.shape, corners)
