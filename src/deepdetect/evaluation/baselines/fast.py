"""FAST 9-16 (Rosten and Drummond, 2006), with SIFT descriptors."""

import cv2

from .method import opencv_method

FAST_DEFAULT = opencv_method("fast", "FAST", cv2.FastFeatureDetector_create)
FAST_LOW = opencv_method(
    "fast-low",
    "FAST, low settings",
    lambda: cv2.FastFeatureDetector_create(threshold=1, nonmaxSuppression=False),
)
