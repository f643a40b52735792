"""Factory functions that are in different modules in different versions of OpenCV."""

from __future__ import annotations

from collections.abc import Callable

from deepdetect._shared.errors import MissingExtraError
from deepdetect._shared.opencv import cv2, installed_distributions


def opencv_factory(name: str) -> Callable[..., cv2.Feature2D]:
    """Return a factory function of OpenCV, such as "AgastFeatureDetector_create".

    OpenCV 5 has some factories in a contrib module, `cv2.xfeatures2d`. Raises a MissingExtraError
    if the contrib modules are needed but not installed.
    """
    for home in (cv2, getattr(cv2, "xfeatures2d", None)):
        if hasattr(home, name):
            factory: Callable[..., cv2.Feature2D] = getattr(home, name)
            return factory
    short = name.removesuffix("_create").removesuffix("FeatureDetector").upper()
    headless = "opencv-python" not in installed_distributions()
    raise MissingExtraError(
        f"{short} needs OpenCV's contrib modules, which the installed OpenCV {cv2.__version__} "
        "lacks: run pip install --force-reinstall --no-deps opencv-contrib-python"
        + ("-headless" if headless else "")
    )
