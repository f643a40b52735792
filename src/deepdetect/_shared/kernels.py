"""How the kernels are compiled. Importing this takes numba; nothing is compiled before a call.

The compiled code is kept where numba keeps it: in NUMBA_CACHE_DIR, in `__pycache__` beside the
module, or in the user's cache folder. Where none of them can be written, as in a read-only
container, it is kept in a folder of this user in the temporary directory, or else not at all.
"""

from __future__ import annotations

import os
import stat
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

_lock = threading.Lock()


def compiled(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function with numba at its first call.

    Args:
        flags: of `numba.njit`, all but `cache`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **flags)(function)
        except RuntimeError:  # numba found no folder that can be written
            return _compiled_elsewhere(function, flags)

    return decorate


def _compiled_elsewhere(function: Callable[..., Any], flags: dict[str, Any]) -> Any:
    """Compile a function for which numba has no folder: with one of ours, or without a cache."""
    folder = _temporary_folder()
    if folder is None:
        return numba.njit(**flags)(function)
    with _lock:
        before = numba.config.CACHE_DIR
        # Read while a function is decorated, not when it is called.
        numba.config.CACHE_DIR = str(folder)
        try:
            return numba.njit(cache=True, **flags)(function)
        except RuntimeError:  # no space left there, or numba was told to look elsewhere only
            return numba.njit(**flags)(function)
        finally:
            numba.config.CACHE_DIR = before


def _temporary_folder() -> Path | None:
    """Return a folder in the temporary directory that is this user's alone, if there can be one.

    Who can write there can have us run anything, and the temporary directory is everyone's.
    """
    if not hasattr(os, "getuid"):
        return None
    try:
        folder = Path(tempfile.gettempdir()) / f"deepdetect-numba-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
    return folder if private and found.st_uid == os.getuid() else None
