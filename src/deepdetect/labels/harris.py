"""Harris: corners of the smoothed gradient covariance (Harris and Stephens, 1988)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class HarrisSettings:
    """Settings of `cv2.cornerHarris`, and the share of the largest response that counts."""

    block_size: int = 3
    aperture: int = 5
    k: float = 0.001
    relative_threshold: float = 0.001
    dilate: bool = True


def harris_mask(gray: np.ndarray, settings: HarrisSettings) -> np.ndarray:
    """Mark the pixels whose Harris response is a given share of the largest one.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask of blobs: the response is widened by 3x3 before the test.
    """
    response = cv2.cornerHarris(gray, settings.block_size, settings.aperture, settings.k)
    if settings.dilate:
        response = cv2.dilate(response, None)
    largest = float(response.max())
    return response > settings.relative_threshold * max(largest, 0.0)
