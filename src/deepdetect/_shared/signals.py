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
    """Have a function called for signals while the block runs, in the main thread.

    A signal that is ignored, as by `nohup`, is left alone, and one that has a handler already,
    but for Ctrl+C.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in names:
            usual = signal.getsignal(getattr(signal, name)) if hasattr(signal, name) else None
            if usual is signal.SIG_DFL or (name == "SIGINT" and usual is not signal.SIG_IGN):
                before[name] = signal.signal(getattr(signal, name), handler)
    try:
        yield
    finally:
        for name, usual in before.items():
            signal.signal(getattr(signal, name), usual)


def exit_by_signal(number: int, frame: FrameType | None) -> None:
    """End the program as a shell reports it; a handler for `handle_signals`."""
    raise SystemExit(128 + number)


@contextmanager
def signals_held() -> Iterator[None]:
    """Let Ctrl-C wait while the block starts processes, and in these until `release_interrupt`."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    # Or the first process starts it, and it ends the mask.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def release_interrupt() -> None:
    """Let Ctrl-C come that `signals_held` holds in a process that has been started."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
