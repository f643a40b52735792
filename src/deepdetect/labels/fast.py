"""FAST: the accelerated segment test on a circle of 16 pixels (Rosten and Drummond, 2006)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .points import keypoints_mask


@dataclass(frozen=True)
class FastSettings:
    """Settings of `cv2.FastFeatureDetector_create`, type 9-16."""

    threshold: int = 13
    suppression: bool = False


def fast_mask(gray: np.ndarray, settings: FastSettings) -> np.ndarray:
    """Mark the FAST corners of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    detector = cv2.FastFeatureDetector_create(
        settings.threshold, settings.suppression, cv2.FAST_FEATURE_DETECTOR_TYPE_9_16
    )
    return keypoints_mask(gray, detector.detect(gray, None))
