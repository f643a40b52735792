"""Seconds and memory of a piece of work."""

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
    """What a piece of work took: wall time, and bytes that the process grew by at most."""

    seconds: float = 0.0
    memory: float = 0.0


_highest = 0
"""The highest of the peaks that were forgotten."""


@contextmanager
def profiled() -> Iterator[Profile]:
    """Measure the time and the growth of memory of a block, which are known when it has ended.

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
    """Return the most memory that the process has held so far, in bytes; 0 where unknown."""
    return max(_highest, _memory("VmHWM"))


def _memory(name: str) -> int:
    """Return a number of bytes of /proc/self/status; the highest so far on other systems."""
    # Linux's ru_maxrss counts what the process that started this one held, too; this does not.
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(f"{name}:"))
    try:
        import resource
    except ImportError:  # on Windows
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def run_in_child(function: Callable[..., Outcome], *arguments: Any) -> Outcome:
    """Call a module's function in a process whose `peak_memory` is that of its work alone.

    OpenCV and our kernels have one thread there. Raises a DeepDetectError where the process was
    ended from outside, else what the function raises.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # Spawned: a fork would begin with all memory of this process.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=start_child) as pool:
        try:
            return pool.submit(function, *arguments).result()
        except BrokenProcessPool:
            raise DeepDetectError(
                "its process was ended, probably for lack of memory: take fewer or smaller images"
            ) from None
