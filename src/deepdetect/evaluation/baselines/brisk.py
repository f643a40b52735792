"""BRISK (Leutenegger et al., 2011), with its own binary descriptors."""

import cv2

from .method import opencv_method
from .opencv_home import find_in_opencv


def _create(*arguments: int) -> cv2.Feature2D:
    return find_in_opencv("BRISK_create")(*arguments)


BRISK_DEFAULT = opencv_method("brisk", "BRISK", _create, _create)
BRISK_LOW = opencv_method("brisk-low", "BRISK, low settings", lambda: _create(1, 4), _create)
