"""pycolmap: imported in the right order, and quiet."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .._shared.errors import MissingExtraError
from .._shared.opencv import import_opencv
from .._shared.signals import sigterm_kept

PIXEL_CENTRE = 0.5
"""COLMAP's position of the centre of the first pixel; ours is 0."""


def import_pycolmap(purpose: str = "a reconstruction from many images") -> Any:
    """Import pycolmap, after OpenCV: the other way round some versions of both crash.

    Args:
        purpose: what it is needed for.

    Raises:
        MissingExtraError: it is not installed, or h5py is not.
    """
    import_opencv()
    with sigterm_kept():  # or a process that is ended would print a stack trace
        try:
            import h5py  # noqa: F401
            import pycolmap
        except ImportError:
            raise MissingExtraError(
                f"{purpose} needs pycolmap and h5py: run pip install pycolmap h5py"
            ) from None
    return pycolmap


@contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """Give pycolmap, and let it log nothing while the block runs."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before
