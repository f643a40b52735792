"""Where OpenCV keeps a detector: version 5 moved some from `cv2` to `cv2.xfeatures2d`."""

from collections.abc import Callable

import cv2


def find_in_opencv(name: str) -> Callable[..., cv2.Feature2D]:
    """Return a function of OpenCV's by name, from wherever this version keeps it."""
    home = cv2 if hasattr(cv2, name) else cv2.xfeatures2d
    return getattr(home, name)
