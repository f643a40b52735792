"""AGAST: the segment test with an adaptive decision tree (Mair et al., 2010)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .points import keypoints_mask


@dataclass(frozen=True)
class AgastSettings:
    """Settings of `cv2.AgastFeatureDetector_create`, type OAST 9-16."""

    threshold: int = 13
    suppression: bool = False


def agast_mask(gray: np.ndarray, settings: AgastSettings) -> np.ndarray:
    """Mark the AGAST corners of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask. With equal settings it equals that of FAST: the two
        test the same circle and differ in the order of the comparisons only.
    """
    # OpenCV 5 keeps AGAST in its contrib module; OpenCV 4 has it in the main one.
    home = cv2 if hasattr(cv2, "AgastFeatureDetector_create") else cv2.xfeatures2d
    oast_9_16 = 3  # AgastFeatureDetector::OAST_9_16
    detector = home.AgastFeatureDetector_create(settings.threshold, settings.suppression, oast_9_16)
    return keypoints_mask(gray, detector.detect(gray, None))
