"""Harris corners (1988) as the paper takes them, with SIFT descriptors.

Every pixel whose response, widened by 3x3, is over a share of the largest is a keypoint of size 3.
"""

from __future__ import annotations

import cv2
import numpy as np

from ...features.keypoints import Keypoints
from ...io.image import luma
from .method import Method, describe_with


def _method(
    name: str, title: str, block_size: int, aperture: int, k: float, share: float
) -> Method:
    def detect(rgb: np.ndarray) -> Keypoints:
        response = cv2.cornerHarris(luma(rgb), block_size, aperture, k)
        response = cv2.dilate(response, None)
        row, column = np.nonzero(response > share * max(float(response.max()), 0.0))
        xy = np.column_stack([column, row])
        return Keypoints(xy, response[row, column], (rgb.shape[1], rgb.shape[0]))

    return Method(name, title, detect, _describe)


def _maxima(rgb: np.ndarray) -> Keypoints:
    response = cv2.cornerHarris(luma(rgb), 3, 3, 0.04)
    peaks = (response == cv2.dilate(response, None)) & (response > 0)
    row, column = np.nonzero(peaks)
    xy = np.column_stack([column, row])
    return Keypoints(xy, response[row, column], (rgb.shape[1], rgb.shape[0]))


def _describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
    return describe_with(cv2.SIFT_create, rgb, features)


HARRIS_MAXIMA = Method("harris-maxima", "Harris, local maxima", _maxima, _describe)
"""As the field takes them: one keypoint a corner, ranked by its response."""

HARRIS_DEFAULT = _method("harris", "Harris", 2, 3, 0.04, 0.04)
HARRIS_LOW = _method("harris-low", "Harris, low settings", 3, 5, 0.001, 0.001)
