"""SIFT (Lowe, 2004), described by SIFT's default settings as in the paper's code."""

import cv2

from .method import opencv_method


def low_sift() -> cv2.SIFT:
    """Make OpenCV's SIFT with the paper's low settings."""
    return cv2.SIFT_create(nOctaveLayers=4, contrastThreshold=1e-9, edgeThreshold=100, sigma=0.7)


SIFT_DEFAULT = opencv_method("sift", "SIFT", cv2.SIFT_create)
SIFT_LOW = opencv_method("sift-low", "SIFT, low settings", low_sift)
