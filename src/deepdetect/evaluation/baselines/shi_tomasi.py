"""Shi-Tomasi corners as the paper takes them (with Harris's score), and SIFT descriptors."""

from __future__ import annotations

import cv2
import numpy as np

from ...features.keypoints import Keypoints
from ...io.image import luma
from .method import Method, describe_with

MOST = 1_000_000


def _method(name: str, title: str, quality: float, k: float) -> Method:
    def detect(rgb: np.ndarray) -> Keypoints:
        corners, scores = cv2.goodFeaturesToTrackWithQuality(
            luma(rgb), MOST, quality, 1, None, useHarrisDetector=True, k=k
        )
        size = (rgb.shape[1], rgb.shape[0])
        if corners is None:
            return Keypoints(np.empty((0, 2)), np.empty(0), size)
        return Keypoints(corners.reshape(-1, 2), scores.reshape(-1), size)

    return Method(name, title, detect, _describe)


def _eigenvalue(rgb: np.ndarray) -> Keypoints:
    gray = luma(rgb)
    size = (rgb.shape[1], rgb.shape[0])
    corners, scores = cv2.goodFeaturesToTrackWithQuality(gray, MOST, 1e-4, 1, None, blockSize=3)
    if corners is None:
        return Keypoints(np.empty((0, 2)), np.empty(0), size)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
    fine = cv2.cornerSubPix(gray, corners.copy(), (2, 2), (-1, -1), criteria)
    # Where the search ran away there was no corner to settle on.
    stayed = np.abs(fine - corners).max(2, keepdims=True) < 1
    return Keypoints(np.where(stayed, fine, corners).reshape(-1, 2), scores.reshape(-1), size)


def _describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
    return describe_with(cv2.SIFT_create, rgb, features)


SHI_TOMASI_EIGENVALUE = Method(
    "shi-tomasi-eigenvalue", "Shi-Tomasi, sub-pixel", _eigenvalue, _describe
)
"""As the field takes them (1994): ranked by the smaller eigenvalue."""

SHI_TOMASI_DEFAULT = _method("shi-tomasi", "Shi-Tomasi", 0.01, 0.04)
SHI_TOMASI_LOW = _method("shi-tomasi-low", "Shi-Tomasi, low settings", 1e-6, 0.001)
