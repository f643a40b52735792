"""Compilation of the kernels by numba, at the first call of each.

Where numba can write to none of the places of its cache, as in a read-only container, the cache is
in a folder of this user in the temporary directory, or else there is none.
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
    """Return a decorator that compiles a function by `numba.njit` at its first call, and caches it.

    Raises:
        MissingExtraError: numba cannot be imported: it takes some versions of NumPy only.
    """
    try:
        import numba
    except ImportError as error:
        raise MissingExtraError(
            f"numba cannot be imported ({first_line(error)}): run pip install --upgrade numba"
        ) from None
    if _announcement:
        _listen()
    config: Any = numba.config  # its names are made at run time

    def decorate(function: Callable[..., Any]) -> Any:
        with suppress(RuntimeError):  # numba found no writable folder
            return numba.njit(cache=True, **flags)(function)
        before = config.CACHE_DIR
        try:
            # Read while a function is decorated, not when it is called.
            config.CACHE_DIR = str(_temporary_folder())
            return numba.njit(cache=True, **flags)(function)
        except (AttributeError, OSError, RuntimeError):  # Windows has no `getuid`
            return numba.njit(**flags)(function)
        finally:
            config.CACHE_DIR = before

    return decorate


def _temporary_folder() -> Path:
    """Return a folder in the temporary directory that only this user can write.

    Whoever can write there can make us run any code.

    Raises:
        OSError: there is none.
    """
    folder = Path(tempfile.gettempdir()) / f"deepdetect-numba-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_mode & 0o077 or found.st_uid != os.getuid():
        raise PermissionError(f"{folder} is not this user's alone")
    return folder
