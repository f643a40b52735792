"""Seconds and memory of a piece of work."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from .._shared.errors import DeepDetectError
from .._shared.parallel import start_child

Outcome = TypeVar("Outcome")


@dataclass
class Profile:
    """What a piece of work took.

    Attributes:
        seconds: wall time.
        memory: bytes that the process grew by at most while it ran.
    """

    seconds: float = 0.0
    memory: int = 0

    def packed(self) -> np.ndarray:
        """Return it as an array, for the cache."""
        return np.array([self.seconds, self.memory], np.float64)

    @classmethod
    def unpacked(cls, array: np.ndarray) -> Profile:
        """Return the profile of `packed`."""
        seconds, memory = array.tolist()
        return cls(seconds, int(memory))


class StageProfiler:
    """Measures stages that follow each other, in a `with` block: `record` ends one.

    The memory is exact on Linux, which is told to forget the peak where a stage begins; elsewhere a
    peak counts where it is the highest of the process so far.

    Attributes:
        stages: by name; stages of one name add up their seconds, the largest memory counts.
        memory: bytes that the process grew by at most since the first stage began, including what
            an earlier stage still holds.

    Example:
        >>> with StageProfiler() as profiler:
        ...     _ = sum(range(1000))
        ...     profiler.record("summing")
        >>> profiler.stages["summing"].seconds > 0
        True
    """

    def __init__(self) -> None:
        self.stages: dict[str, Profile] = {}
        self.memory = 0

    def __enter__(self) -> StageProfiler:
        _RUNNING.append(self)
        self._begin()
        self._first = self._before
        return self

    def __exit__(self, *_: object) -> None:
        _RUNNING.remove(self)

    def record(self, name: str) -> None:
        """End a stage, and begin the next one."""
        seconds = time.perf_counter() - self._started
        _forget_peak()
        profile = self.stages.setdefault(name, Profile())
        profile.seconds += seconds
        profile.memory = max(profile.memory, self._peak - self._before)
        self.memory = max(self.memory, self._peak - self._first)
        self._begin()

    def _begin(self) -> None:
        _forget_peak()
        self._before = self._peak = _memory("VmRSS")
        self._started = time.perf_counter()


_RUNNING: list[StageProfiler] = []
"""Those in whose blocks the process is: blocks may be nested."""

_highest = 0


def _forget_peak() -> None:
    """Note the peak of the process in all that are running, and let it begin anew."""
    global _highest
    peak = _memory("VmHWM")
    _highest = max(_highest, peak)
    for profiler in _RUNNING:
        profiler._peak = max(getattr(profiler, "_peak", 0), peak)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM, see man 5 proc


@contextmanager
def profiled() -> Iterator[Profile]:
    """Measure the time and the growth of memory of the block.

    Example:
        >>> with profiled() as profile:
        ...     _ = sum(range(1000))
        >>> profile.seconds > 0
        True
    """
    profile = Profile()
    with StageProfiler() as profiler:
        try:
            yield profile
        finally:
            profiler.record("block")
            recorded = profiler.stages["block"]
            profile.seconds, profile.memory = recorded.seconds, recorded.memory


def peak_memory() -> int:
    """Return the most memory that the process has held so far, in bytes; 0 where unknown.

    Example:
        >>> peak_memory() > 1_000_000
        True
    """
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
    """Call a function in a process of its own, whose `peak_memory` is that of its work alone.

    OpenCV and our kernels have one thread there.

    Args:
        function: of a module.
        arguments: what can be pickled.

    Raises:
        DeepDetectError: the process was ended from outside; or what the function raises.

    Example:
        >>> run_in_child(max, 1, 2)
        2
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
                "its process was ended by the system, probably for lack of memory: take fewer or "
                "smaller images"
            ) from None
