"""Measure time and memory of a piece of work."""

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
    """Wall time of some work, and the largest growth of the process's memory in bytes."""

    seconds: float = 0.0
    memory: float = 0.0


_highest = 0
"""The highest peak that was reset, in bytes."""


@contextmanager
def profiled() -> Iterator[Profile]:
    """Measure time and memory growth of a block; read the values after the block.

    The memory is exact on Linux, which is told to forget the peak where a block begins; elsewhere a
    peak counts where it is the highest of the process so far. No two blocks may run at a time.
    """
    global _highest
    _highest = peak_memory()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM, see man 5 proc
    profile, before, started = Profile(), _memory("VmRSS"), time.perf_counter()
    yield profile
    profile.seconds = time.perf_counter() - started
    profile.memory = max(_memory("VmHWM") - before, 0)


def peak_memory() -> int:
    """Return the peak memory of the process so far, in bytes; 0 if unknown."""
    return max(_highest, _memory("VmHWM"))


def _memory(name: str) -> int:
    """Return a memory value of /proc/self/status in bytes; the peak so far on other systems."""
    # Linux's ru_maxrss includes the memory of the parent process; /proc/self/status is exact.
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

    OpenCV and our kernels use one thread there. Errors of the function are passed on; a
    DeepDetectError is raised if the process is killed.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # A forked process would start with all memory of this one, so a new one is spawned.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=start_child) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise DeepDetectError(
                "the process was killed, probably for lack of memory: use fewer or smaller images"
            ) from None
