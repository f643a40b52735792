"""How long the stages of a computation take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class StageTimer:
    """Measures the stages of a computation in seconds, and reports each one as it ends.

    Example:
        >>> timer = StageTimer(progress=print)
        >>> with timer.stage("matching"):
        ...     pass
        matching
        >>> list(timer.seconds)
        ['matching']
    """

    def __init__(self, progress: Callable[[str], object] | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what runs inside as the stage of this name."""
        started = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started
        if self._progress is not None:
            self._progress(name)
