"""Canny: thin edges by gradient maxima and hysteresis (Canny, 1986)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class CannySettings:
    """The two thresholds of `cv2.Canny`; the image is not blurred before."""

    low_threshold: float = 150.0
    high_threshold: float = 250.0


def canny_mask(gray: np.ndarray, settings: CannySettings) -> np.ndarray:
    """Mark the Canny edges of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    return cv2.Canny(gray, settings.low_threshold, settings.high_threshold) > 0
