"""ORB (Rublee et al., 2011), with its own binary descriptors."""

import cv2

from .method import opencv_method

ORB_DEFAULT = opencv_method("orb", "ORB", cv2.ORB_create, cv2.ORB_create)
ORB_LOW = opencv_method(
    "orb-low",
    "ORB, low settings",
    lambda: cv2.ORB_create(nfeatures=1_000_000, fastThreshold=1),
    cv2.ORB_create,
)
