"""Signals that ask a process to end: the one place where their handlers are set."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

ENDING = ("SIGTERM", "SIGHUP")
"""Sent by `kill`, and by a terminal that is closed; Windows lacks the second."""


@contextmanager
def handle_signals(
    handler: Callable[[int, FrameType | None], object], names: Sequence[str] = ENDING
) -> Iterator[None]:
    """Have a function called for signals while the block runs.

    A signal that is ignored, as by `nohup`, or that has a handler of its own, is left alone;
    Python's own for Ctrl+C counts as none. Outside the main thread, where Python allows no
    handlers, nothing is done.

    Args:
        handler: called with the number of the signal, and the frame.
        names: of the signals.

    Example:
        >>> with handle_signals(lambda number, frame: print("ended"), ["SIGTERM"]):
        ...     signal.raise_signal(signal.SIGTERM)
        ended
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in names:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) in (
                signal.SIG_DFL,
                signal.default_int_handler,
            ):
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
