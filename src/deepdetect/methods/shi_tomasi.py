"""Shi-Tomasi corners as the paper takes them (with Harris's score), and SIFT descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from ..image import luma
from .features import Features
from .method import Method, describe_with

MOST = 1_000_000


def _method(name: str, title: str, quality: float, k: float) -> Method:
    def detect(rgb: np.ndarray) -> Features:
        corners, scores = cv2.goodFeaturesToTrackWithQuality(
            luma(rgb), MOST, quality, 1, None, useHarrisDetector=True, k=k
        )
        size = (rgb.shape[1], rgb.shape[0])
        if corners is None:
            return Features(np.empty((0, 2)), np.empty(0), size)
        return Features(corners.reshape(-1, 2), scores.reshape(-1), size)

    def describe(rgb: np.ndarray, features: Features) -> np.ndarray:
        return describe_with(cv2.SIFT_create, rgb, features)

    return Method(name, title, detect, describe)


SHI_TOMASI_DEFAULT = _method("shi-tomasi", "Shi-Tomasi", 0.01, 0.04)
SHI_TOMASI_LOW = _method("shi-tomasi-low", "Shi-Tomasi, low settings", 1e-6, 0.001)
