"""Compilation of kernels by numba: each is compiled at its first call and cached on disk.

If numba cannot write to its usual cache folders, as in a read-only container, it uses a private
folder of this user in the temporary directory. If that folder cannot be made, nothing is cached.
"""

from __future__ import annotations

import functools
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from .errors import MissingExtraError, first_line
from .machine import temporarily

_announcement: list[Callable[[], object]] = []


def announce_compilation(tell: Callable[[], object]) -> None:
    """Let `tell` be called once, before the first compilation of a kernel that is not cached."""
    _announcement[:] = [tell]


@functools.cache
def _listen() -> None:
    """Call `announce_compilation`'s function when numba first compiles a kernel without a cache."""
    from numba.core import event as events

    class Listener(events.Listener):
        def on_start(self, event: Any) -> None:
            if _announcement:
                _announcement.pop()()

        def on_end(self, event: Any) -> None:
            pass

    events.register("numba:compile", Listener())  # type: ignore[no-untyped-call]


def compiled(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function by `numba.njit` at its first call, and caches it.

    Raises:
        MissingExtraError: numba is missing, or does not support the installed version of NumPy.
    """
    try:
        import numba
    except ImportError as error:
        raise MissingExtraError(
            f"numba cannot be imported ({first_line(error)}): run pip install --upgrade numba"
        ) from None
    if _announcement:
        _listen()

    def decorate(function: Callable[..., Any]) -> Any:
        with suppress(RuntimeError):  # numba found no writable cache folder
            return numba.njit(cache=True, **flags)(function)
        missing = AttributeError, OSError, RuntimeError  # AttributeError: Windows lacks `getuid`
        # Numba reads `CACHE_DIR` while a function is decorated, not when it is called.
        with suppress(*missing), temporarily(numba.config, CACHE_DIR=str(_temporary_folder())):
            return numba.njit(cache=True, **flags)(function)
        return numba.njit(**flags)(function)

    return decorate


def _temporary_folder() -> Path:
    """Return a temporary folder that only this user can write, or raise an OSError.

    Anyone who can write to a cache of compiled code can make this process run any code.
    """
    folder = Path(tempfile.gettempdir()) / f"deepdetect-numba-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_mode & 0o077 or found.st_uid != os.getuid():
        raise PermissionError(f"{folder} is not private to this user")
    return folder
