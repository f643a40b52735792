"""BRISK: AGAST corners in a continuous scale space (Leutenegger et al., 2011)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from .points import keypoints_mask


@dataclass(frozen=True)
class BriskSettings:
    """Settings of `cv2.BRISK_create`."""

    threshold: int = 11
    octaves: int = 3


@lru_cache(maxsize=8)
def _detector(settings: BriskSettings) -> cv2.Feature2D:
    """Make the detector once: building its sampling pattern costs as much as a dark image."""
    # OpenCV 5 keeps BRISK in its contrib module; OpenCV 4 has it in the main one.
    create = cv2.BRISK_create if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d.BRISK_create
    return create(thresh=settings.threshold, octaves=settings.octaves)


def brisk_mask(gray: np.ndarray, settings: BriskSettings) -> np.ndarray:
    """Mark the BRISK keypoints of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    return keypoints_mask(gray, _detector(settings).detect(gray, None))
