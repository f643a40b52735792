"""SIFT (Lowe, 2004), with its own descriptors."""

import cv2

from .method import opencv_method

SIFT_DEFAULT = opencv_method("sift", "SIFT", cv2.SIFT_create)
SIFT_LOW = opencv_method(
    "sift-low",
    "SIFT, low settings",
    lambda: cv2.SIFT_create(nOctaveLayers=4, contrastThreshold=1e-9, edgeThreshold=100, sigma=0.7),
)
