"""Seconds and memory of a piece of work."""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

INTERVAL = 0.005  # seconds between two looks at the memory
STATUS = Path("/proc/self/statm")


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

    The memory is looked at every 5 ms; where the system does not tell it (not Linux), the
    growth of the process's peak is taken instead, which is 0 when it was higher before.

    Example:
        >>> with metered() as meter:
        ...     _ = sum(range(1000))
        >>> meter.seconds > 0
        True
    """
    meter = Meter()
    before = _resident()
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(INTERVAL):
            meter.memory = max(meter.memory, _resident() - before)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    started = time.perf_counter()
    try:
        yield meter
    finally:
        meter.seconds = time.perf_counter() - started
        stop.set()
        watcher.join()
        meter.memory = max(meter.memory, _resident() - before)


def _resident() -> int:
    """Return the memory of this process in bytes."""
    if STATUS.exists():
        return int(STATUS.read_text().split()[1]) * resource.getpagesize()
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
