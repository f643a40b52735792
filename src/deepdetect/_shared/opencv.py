"""OpenCV, imported when it is first used, whichever of its packages is installed.

They all install into one folder `cv2`, a later one over an earlier one. Modules write
`from .._shared.opencv import cv2`.
"""

from __future__ import annotations

import functools
import importlib
import re
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .errors import MissingExtraError, first_line, require_packages
from .signals import sigterm_kept

LOWEST_VERSION = "4.12"
"""The first one that writes the EXIF of a picture."""

DISTRIBUTIONS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
"""The packages on PyPI that bring `cv2`."""


class _OpenCV(ModuleType):
    """Stands for `cv2`, and imports it when it is asked for anything."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_opencv(), name)


if TYPE_CHECKING:
    import cv2 as cv2
else:
    cv2 = _OpenCV("cv2")


@functools.cache
def import_opencv() -> ModuleType:
    """Import OpenCV.

    Raises:
        MissingExtraError: there is none, it cannot be imported, or it is too old.
    """
    try:
        found = importlib.import_module("cv2")
    except ImportError as error:
        raise MissingExtraError(
            f"OpenCV cannot be imported ({first_line(error)}): run pip install "
            "opencv-python-headless, which needs no libraries of a screen, or any other package "
            f"of OpenCV {LOWEST_VERSION} or later"
        ) from None
    version = getattr(found, "__version__", None)
    if version is None:  # a folder `cv2` that another package of OpenCV has left behind
        raise MissingExtraError(
            "the folder cv2 of the installed OpenCV is not complete, as after the removal of "
            "another package of it: pip install --force-reinstall opencv-python-headless"
        )
    if version_numbers(version) < version_numbers(LOWEST_VERSION):
        raise MissingExtraError(
            f"OpenCV {version} is installed, and {LOWEST_VERSION} or later is needed: "
            f"pip install --upgrade {' '.join(installed_distributions()) or 'opencv-python'}"
        )
    return found


def import_pycolmap(purpose: str = "a reconstruction from many images") -> Any:
    """Import pycolmap, after OpenCV: the other way round some versions of both crash.

    A MissingExtraError says that it, or h5py, is not installed, and what it is needed for.
    """
    import_opencv()
    require_packages(purpose, "pycolmap", "h5py")
    with sigterm_kept():  # or a process that is ended would print a stack trace
        import pycolmap
    return pycolmap


def is_lack_of_memory(error: Exception) -> bool:
    """Return whether an exception is OpenCV's for lack of memory; OpenCV is not imported for it."""
    loaded = sys.modules.get("cv2")
    wanted = loaded is not None and isinstance(error, loaded.error)
    return wanted and getattr(error, "code", None) == cv2.Error.StsNoMem


def opencv_factory(name: str) -> Callable[..., cv2.Feature2D]:
    """Return a factory of OpenCV, as "AgastFeatureDetector_create".

    Version 5 moved some from `cv2` to `cv2.xfeatures2d`, which is one of the contrib modules.

    Raises:
        MissingExtraError: it is in the contrib modules, and these are not installed.
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


def installed_distributions() -> list[str]:
    """Return which of the packages that bring `cv2` are installed."""
    import importlib.metadata  # takes longer than all of this package

    installed = {each.name for each in importlib.metadata.distributions()}
    return [name for name in DISTRIBUTIONS if name in installed]


def version_numbers(version: str) -> list[int]:
    """Return what versions are compared by."""
    return [int(part) for part in re.findall(r"\d+", version)]
