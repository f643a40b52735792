"""OpenCV, imported at its first use, from whichever of its PyPI packages is installed.

These packages share one folder `cv2`, so installing one overwrites the files of another. The
modules of DeepDetect write `from .._shared.opencv import cv2`.
"""

from __future__ import annotations

import functools
import importlib
import re
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .errors import MissingExtraError, first_line, require_packages
from .signals import sigterm_kept

LOWEST_VERSION = "4.13"
"""Lowest supported version of OpenCV: 4.12 silently writes images without their ICC profiles."""

DISTRIBUTIONS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
"""Packages on PyPI that contain `cv2`."""


class _OpenCV(ModuleType):
    """Stand-in for `cv2` that imports it at the first access to an attribute."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_opencv(), name)


if TYPE_CHECKING:
    import cv2 as cv2
else:
    cv2 = _OpenCV("cv2")


@functools.cache
def import_opencv() -> ModuleType:
    """Import OpenCV, or raise a MissingExtraError if it is missing, broken or too old."""
    try:
        found = importlib.import_module("cv2")
    except ImportError as error:
        raise MissingExtraError(
            f"OpenCV cannot be imported ({first_line(error)}): run pip install "
            "opencv-python-headless, which needs no display, or another package of OpenCV "
            f"{LOWEST_VERSION} or later"
        ) from None
    version = getattr(found, "__version__", None)
    if version is None:  # removing a package has left an incomplete folder `cv2`
        raise MissingExtraError(
            "the folder cv2 of the installed OpenCV is incomplete, perhaps because another package "
            "of OpenCV was removed: run pip install --force-reinstall opencv-python-headless"
        )
    if version_numbers(version) < version_numbers(LOWEST_VERSION):
        raise MissingExtraError(
            f"OpenCV {version} is installed, but {LOWEST_VERSION} or later is needed: run "
            f"pip install --upgrade {' '.join(installed_distributions()) or 'opencv-python'}"
        )
    return found


def import_pycolmap(purpose: str = "a reconstruction from many images") -> Any:
    """Import pycolmap, after OpenCV, because some versions crash in the other order.

    Raises a MissingExtraError that names the purpose if pycolmap or h5py is not installed.
    """
    import_opencv()
    require_packages(purpose, "pycolmap", "h5py")
    with sigterm_kept():  # pycolmap's import sets a handler that prints a stack trace
        import pycolmap
    return pycolmap


def is_lack_of_memory(error: Exception) -> bool:
    """Return whether OpenCV raised this error for lack of memory, without importing OpenCV."""
    loaded = sys.modules.get("cv2")
    wanted = loaded is not None and isinstance(error, loaded.error)
    return wanted and getattr(error, "code", None) == cv2.Error.StsNoMem


def installed_distributions() -> list[str]:
    """Return the installed packages that contain `cv2`."""
    import importlib.metadata  # here, because its import is slow

    installed = {each.name for each in importlib.metadata.distributions()}
    return [name for name in DISTRIBUTIONS if name in installed]


def version_numbers(version: str) -> list[int]:
    """Return the numbers in a version string, for comparing versions."""
    return [int(part) for part in re.findall(r"\d+", version)]
