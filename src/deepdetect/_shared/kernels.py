"""Compilation of the kernels by numba, at the first call of each.

The compiled code is cached where numba does so: in NUMBA_CACHE_DIR, in `__pycache__` beside the
module, or in the user's cache folder. Where none of them can be written, as in a read-only
container, it is cached in a folder of this user in the temporary directory, or else not at all.
"""

from __future__ import annotations

import functools
import os
import stat
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .errors import MissingExtraError

_lock = threading.Lock()
_announcement: list[Callable[[], object]] = []


def announce_compilation(tell: Callable[[], object]) -> None:
    """Have a function called once, before the first kernel is compiled that no cache holds."""
    _announcement[:] = [tell]


@functools.cache
def _listen() -> None:
    """Wait for the first compilation, which numba tells of when it finds nothing in its cache."""
    from numba.core import event as events

    class Listener(events.Listener):
        def on_start(self, event: Any) -> None:
            if _announcement:
                _announcement.pop()()

        def on_end(self, event: Any) -> None:
            pass

    events.register("numba:compile", Listener())  # type: ignore[no-untyped-call]


def compiled(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function with numba at its first call, and caches it.

    Args:
        flags: of `numba.njit`, all but `cache`.

    Raises:
        MissingExtraError: numba cannot be imported: it takes some versions of NumPy only.
    """
    try:
        import numba
    except ImportError as error:
        reason = str(error).partition("\n")[0]
        raise MissingExtraError(
            f"numba cannot be imported ({reason}): run pip install --upgrade numba"
        ) from None
    if _announcement:
        _listen()
    config: Any = numba.config  # its names are made at run time

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **flags)(function)
        except RuntimeError:  # numba found no writable folder
            folder = _temporary_folder()
        if folder is None:
            return numba.njit(**flags)(function)
        with _lock:
            before = config.CACHE_DIR
            # Read while a function is decorated, not when it is called.
            config.CACHE_DIR = str(folder)
            try:
                return numba.njit(cache=True, **flags)(function)
            except RuntimeError:  # no space left there, or numba is set to look elsewhere only
                return numba.njit(**flags)(function)
            finally:
                config.CACHE_DIR = before

    return decorate


def _temporary_folder() -> Path | None:
    """Return a folder in the temporary directory that only this user can write, if possible.

    Whoever can write there can make us run any code.
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
