"""Progress bars of long tasks, and times of stages."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partialmethod
from typing import Any


class _StandardError:
    """A stream that writes to the current `sys.stderr`, unless that is None, closed or full."""

    encoding = "utf-8"

    def _called(self, method: str, *values: str) -> object:
        with suppress(AttributeError, OSError, ValueError):
            return getattr(sys.stderr, method)(*values)
        return False

    write = partialmethod(_called, "write")
    flush = partialmethod(_called, "flush")
    isatty = partialmethod(_called, "isatty")


STDERR: Any = _StandardError()


def fails(stream: Any) -> bool:
    """Return whether writing to a stream fails (full disk, broken pipe); if so, discard output."""
    if stream is None:
        return False
    try:
        print(file=stream, end="\n" if stream is sys.stdout else "", flush=True)
        return False
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return True


def progress(total: int | None, title: str, unit: str, quiet: bool = False, done: int = 0) -> Any:
    """Return a tqdm progress bar on standard error that starts with `done` of `total` units."""
    from tqdm import tqdm

    return tqdm(
        total=total,
        initial=done,
        desc=title,
        unit=unit,
        disable=quiet or total == 0,
        file=STDERR,
        dynamic_ncols=True,
        mininterval=0.2 if STDERR.isatty() else 10,
    )


@contextmanager
def stage_progress(
    title: str, stages: Sequence[str] = (), quiet: bool = False
) -> Iterator[Callable[[str], None]]:
    """Show a progress bar of stages; yield a function to call with the name of each ended stage.

    The bar names the running stage or, if `stages` is empty, the last ended stage.
    """
    # The bar appears only on a terminal, so that logs stay readable.
    quiet = quiet or not STDERR.isatty()
    with progress(len(stages) or None, title, "stage", quiet) as bar:
        bar.set_postfix_str(stages[0] if stages else "")

        def done(stage: str) -> None:
            bar.update()
            bar.set_postfix_str(stages[bar.n] if bar.n < len(stages) else stage)

        yield done


def say(text: str) -> None:
    """Write a line to standard error, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(text, file=STDERR)


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
        """Add the time of the block to the stage of this name, then report the stage."""
        started = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        if self._progress is not None:
            self._progress(name)
