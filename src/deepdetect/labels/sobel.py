"""Sobel: thick edges where a wide derivative filter gives a large gradient."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class SobelSettings:
    """Width of the derivative filter, and the share of the largest gradient that counts."""

    kernel_size: int = 11
    relative_threshold: float = 0.1


def sobel_mask(gray: np.ndarray, settings: SobelSettings) -> np.ndarray:
    """Mark the pixels whose gradient is a given share of the largest one.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask of thick lines.
    """
    dx = cv2.Sobel(gray, cv2.CV_64F, 1, 0, ksize=settings.kernel_size)
    dy = cv2.Sobel(gray, cv2.CV_64F, 0, 1, ksize=settings.kernel_size)
    magnitude = cv2.magnitude(dx, dy)
    return magnitude > settings.relative_threshold * float(magnitude.max())
