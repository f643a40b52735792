"""Compilation of the kernels by numba, at the first call of each.

The compiled code is cached where numba does so: in NUMBA_CACHE_DIR, in `__pycache__` beside the
module, or in the user's cache folder. Where none of them can be written, as in a read-only
container, it is cached in a folder of this user in the temporary directory, or else not at all.
"""

from __future__ import annotations

import functools
import importlib.util
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
_cache_folders: set[Path] = set()
"""Where numba keeps the kernels of the modules that have been imported."""


def announce_compilation(tell: Callable[[], object]) -> None:
    """Have a function called before the first kernel is compiled, where no cache holds any."""
    _announcement[:] = [tell]


@functools.cache
def _listen() -> None:
    """Wait for the first compilation, which numba tells of when it finds nothing in its cache."""
    from numba.core import event as events

    class Listener(events.Listener):
        def on_start(self, event: Any) -> None:
            if _announcement:
                tell = _announcement.pop()
                if not any(any(folder.glob("*.nbi")) for folder in _cache_folders):
                    tell()

        def on_end(self, event: Any) -> None:
            pass

    events.register("numba:compile", Listener())  # type: ignore[no-untyped-call]


def has_compiler() -> bool:
    """Return whether numba is installed."""
    return importlib.util.find_spec("numba") is not None


def require_compiler(task: str, instead: str = "") -> None:
    """Stop before work that ends in compiled code, where numba is not installed.

    Args:
        task: what needs it, as "guided matching".
        instead: what does without, for the end of the message.

    Raises:
        MissingExtraError: it is not installed.
    """
    if not has_compiler():
        raise _missing(task, instead)


def _missing(task: str, instead: str = "", reason: str = "is not installed") -> MissingExtraError:
    return MissingExtraError(f"{task} needs numba, which {reason}: run pip install numba{instead}")


def _import_numba() -> Any:
    """Import numba.

    Raises:
        MissingExtraError: it is not installed, or not for the other packages that are.
    """
    try:
        import numba
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        raise _missing("this") from None
    except ImportError as error:  # it takes some versions of NumPy only
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise _missing("this", reason=f"cannot be imported ({reason})") from None
    if _announcement:
        _listen()
    return numba


def compiled(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function with numba at its first call, and caches it.

    Args:
        flags: of `numba.njit`, all but `cache`.

    Raises:
        MissingExtraError: numba is not installed.
    """
    numba = _import_numba()

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            kernel = numba.njit(cache=True, **flags)(function)
        except RuntimeError:  # numba found no writable folder
            kernel = _compiled_elsewhere(function, flags)
        if kernel.stats.cache_path is not None:
            _cache_folders.add(Path(kernel.stats.cache_path))
        return kernel

    return decorate


def _compiled_elsewhere(function: Callable[..., Any], flags: dict[str, Any]) -> Any:
    """Compile with a cache folder of our own, or without a cache."""
    numba = _import_numba()
    config: Any = numba.config  # its names are made at run time
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
