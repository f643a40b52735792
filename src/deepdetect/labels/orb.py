"""ORB: FAST corners on an image pyramid (Rublee et al., 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .points import keypoints_mask


@dataclass(frozen=True)
class OrbSettings:
    """Settings of `cv2.ORB_create`; `features` is so large that nothing is cut off."""

    features: int = 1_000_000
    scale_factor: float = 1.2
    levels: int = 7
    edge_threshold: int = 13
    fast_threshold: int = 13


def orb_mask(gray: np.ndarray, settings: OrbSettings) -> np.ndarray:
    """Mark the ORB keypoints of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    detector = cv2.ORB_create(
        nfeatures=settings.features,
        scaleFactor=settings.scale_factor,
        nlevels=settings.levels,
        edgeThreshold=settings.edge_threshold,
        fastThreshold=settings.fast_threshold,
    )
    return keypoints_mask(gray, detector.detect(gray, None))
