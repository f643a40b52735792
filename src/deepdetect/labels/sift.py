"""SIFT: extrema of the difference-of-Gaussians scale space (Lowe, 2004)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .points import keypoints_mask


@dataclass(frozen=True)
class SiftSettings:
    """Settings of `cv2.SIFT_create`; the edge test is all but switched off."""

    contrast_threshold: float = 0.04
    edge_threshold: float = 1000.0
    sigma: float = 1.6
    octave_layers: int = 3


def sift_mask(gray: np.ndarray, settings: SiftSettings) -> np.ndarray:
    """Mark the SIFT keypoints of a grey image.

    Args:
        gray: (H, W) uint8 luma.
        settings: the detector's settings.

    Returns:
        (H, W) bool mask.
    """
    detector = cv2.SIFT_create(
        nOctaveLayers=settings.octave_layers,
        contrastThreshold=settings.contrast_threshold,
        edgeThreshold=settings.edge_threshold,
        sigma=settings.sigma,
    )
    return keypoints_mask(gray, detector.detect(gray, None))
