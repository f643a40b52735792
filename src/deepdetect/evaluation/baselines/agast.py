"""AGAST (Mair et al., 2010), with SIFT descriptors."""

import cv2

from .method import opencv_method
from .opencv_home import find_in_opencv

AGAST_7_12D = 1
"""AgastFeatureDetector::AGAST_7_12d, the type of the paper's low settings."""


def _create(*arguments: object) -> cv2.Feature2D:
    return find_in_opencv("AgastFeatureDetector_create")(*arguments)


AGAST_DEFAULT = opencv_method("agast", "AGAST", _create)
AGAST_LOW = opencv_method(
    "agast-low", "AGAST, low settings", lambda: _create(1, False, AGAST_7_12D)
)
