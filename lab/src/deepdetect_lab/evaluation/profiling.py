"""Measure the time and the memory that a block of code or a function needs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from deepdetect._shared.errors import DeepDetectError
from deepdetect._shared.machine import start_child

Outcome = TypeVar("Outcome")


@dataclass
class Profile:
    """Seconds that a `profiled` block took, and bytes from the memory at its start to the peak."""

    seconds: float = 0.0
    memory: float = 0.0


_highest = 0
"""Peak memory of the process in bytes, up to the time when `profiled` last reset its counter."""


@contextmanager
def profiled() -> Iterator[Profile]:
    """Measure time and memory growth of a `with` block. Read the `Profile` after the block.

    On Linux the memory is exact, because the counter of peak memory is reset when the block begins.
    Other systems cannot reset it, so growth is only measured if the block needs more memory than
    the process has ever had. Two blocks must not run at the same time.
    """
    global _highest
    _highest = peak_memory()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM, the peak
    profile, before, started = Profile(), _memory("VmRSS"), time.perf_counter()
    yield profile
    profile.seconds = time.perf_counter() - started
    profile.memory = max(_memory("VmHWM") - before, 0)


def peak_memory() -> int:
    """Return the peak memory of the process so far, in bytes; 0 if unknown."""
    return max(_highest, _memory("VmHWM"))


def _memory(name: str) -> int:
    """Return a value of Linux's /proc/self/status in bytes; on other systems, the peak memory."""
    # On Linux ru_maxrss includes memory of the parent process. /proc/self/status does not.
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(f"{name}:"))
    try:
        import resource
    except ImportError:  # on Windows
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def run_in_child(function: Callable[..., Outcome], *arguments: Any) -> Outcome:
    """Call a module-level function in a new process, so that `peak_memory` measures only its work.

    OpenCV and this package's kernels use one thread in that process. If the function raises an
    error, it is raised here. If the process is killed, a DeepDetectError is raised.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # A forked process would start with all memory of its parent, so a new process is spawned.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=start_child) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise DeepDetectError(
                "the process was killed, probably for lack of memory: use fewer or smaller images"
            ) from None
