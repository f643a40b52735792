"""Seconds and memory of a piece of work."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from .._shared.errors import DeepDetectError, MissingExtraError
from .._shared.parallel import start_child

Outcome = TypeVar("Outcome")

SAMPLING_INTERVAL_S = 0.005


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

    A thread samples the memory of the process; a peak that it misses counts where it is the highest
    of the process so far.

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
        self._process = _process()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> StageProfiler:
        self._begin()
        self._first = self._before
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()

    def record(self, name: str) -> None:
        """End a stage, and begin the next one."""
        seconds = time.perf_counter() - self._started
        peak = max(self._peak, self._resident())
        if peak_memory() > self._peak_before:
            peak = max(peak, peak_memory())
        profile = self.stages.setdefault(name, Profile())
        profile.seconds += seconds
        profile.memory = max(profile.memory, peak - self._before, 0)
        self.memory = max(self.memory, peak - self._first)
        self._begin()

    def _begin(self) -> None:
        self._before = self._peak = self._resident()
        self._peak_before = peak_memory()
        self._started = time.perf_counter()

    def _resident(self) -> int:
        return int(self._process.memory_info().rss)

    def _sample(self) -> None:
        while not self._stop.wait(SAMPLING_INTERVAL_S):
            self._peak = max(self._peak, self._resident())


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
    # Linux counts what the process that started this one held as its maximum, too; here it does
    # not.
    with suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    try:
        import resource
    except ImportError:  # on Windows
        return int(getattr(_process().memory_info(), "peak_wset", 0))
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


def _process() -> Any:
    try:
        import psutil
    except ImportError:
        raise MissingExtraError(
            "measuring memory needs the package psutil, which is not installed: "
            "run pip install psutil"
        ) from None
    return psutil.Process()
