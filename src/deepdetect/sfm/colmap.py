"""pycolmap: imported in the right order, and quiet."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .._shared.errors import MissingExtraError
from .._shared.opencv import import_opencv

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
    first = "pycolmap" not in sys.modules
    try:
        import h5py  # noqa: F401
        import pycolmap
    except ImportError:
        raise MissingExtraError(
            f"{purpose} needs pycolmap and h5py: run pip install pycolmap h5py"
        ) from None
    if first:
        _restore_sigterm()
    return pycolmap


def _restore_sigterm() -> None:
    """Undo what pycolmap does at import: a process that is ended would print a stack trace."""
    handler = signal.getsignal(signal.SIGTERM)  # Python does not know that it has been replaced
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


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
