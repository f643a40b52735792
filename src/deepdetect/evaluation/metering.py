"""Seconds and memory of a piece of work."""

from __future__ import annotations

import ctypes
import platform
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

STATUS = Path("/proc/self/status")
RESET = Path("/proc/self/clear_refs")
_highest = 0


@dataclass
class Meter:
    """What a piece of work took.

    Attributes:
        seconds: wall time.
        memory: bytes that the process grew by at the most while it ran.
    """

    seconds: float = 0.0
    memory: int = 0


@contextmanager
def metered() -> Iterator[Meter]:
    """Measure the time and the growth of memory of the block.

    Before it, freed memory goes back to the system as far as that can be done, and on Linux the
    process's peak is reset, so that each block is told by itself. Elsewhere it is the growth of
    the peak, which is 0 when something before the block took more.

    Example:
        >>> with metered() as meter:
        ...     _ = sum(range(1000))
        >>> meter.seconds > 0
        True
    """
    meter = Meter()
    before = _start()
    started = time.perf_counter()
    try:
        yield meter
    finally:
        meter.seconds = time.perf_counter() - started
        meter.memory = max(_peak() - before, 0)


class StageMeters:
    """Measures stages that follow each other: `lap` ends one and begins the next.

    Attributes:
        stages: by name; stages of one name add up their seconds, the largest memory counts.
        memory: bytes that the process grew by at the most since the first stage began: what an
            earlier stage still holds counts, too.

    Example:
        >>> meters = StageMeters()
        >>> _ = sum(range(1000))
        >>> meters.lap("summing")
        >>> meters.stages["summing"].seconds > 0
        True
    """

    def __init__(self) -> None:
        self.stages: dict[str, Meter] = {}
        self.memory = 0
        self._begin()
        self._first = self._before

    def lap(self, name: str) -> None:
        """End a stage."""
        seconds = time.perf_counter() - self._started
        peak = _peak()
        memory = max(peak - self._before, 0)
        self.memory = max(self.memory, peak - self._first)
        meter = self.stages.setdefault(name, Meter())
        meter.seconds += seconds
        meter.memory = max(meter.memory, memory)
        self._begin()

    def _begin(self) -> None:
        self._before = _start()
        self._started = time.perf_counter()


def peak_memory() -> int:
    """Return the most memory that the process has held so far, in bytes.

    The system's own number is gone after a `metered` block, which resets it.

    Example:
        >>> peak_memory() > 1_000_000
        True
    """
    return max(_highest, _peak())


def _start() -> int:
    """Give freed memory back and reset the peak; return the memory in use, in bytes."""
    global _highest
    _highest = peak_memory()
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)
    try:
        RESET.write_text("5")  # resets VmHWM; see proc(5)
    except OSError:
        return _peak()
    return _status("VmRSS")


def _peak() -> int:
    if STATUS.exists():
        return _status("VmHWM")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _status(name: str) -> int:
    """Read a line of the process's status, in bytes."""
    for line in STATUS.read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    return 0
