"""ORB (Rublee et al., 2011), with its own binary descriptors."""

import cv2

from .method import opencv_method

ORB_DEFAULT = opencv_method("orb", "ORB", cv2.ORB_create, cv2.ORB_create)
ORB_MANY = opencv_method(
    "orb-many", "ORB", lambda: cv2.ORB_create(nfeatures=10_000), cv2.ORB_create
)
"""The default stops at 500 keypoints."""

ORB_LOW = opencv_method(
    "orb-low",
    "ORB, low settings",
    lambda: cv2.ORB_create(nfeatures=1_000_000, fastThreshold=1),
    cv2.ORB_create,
)
