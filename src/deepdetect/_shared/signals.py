"""Signals that ask a process to end: the one place where they are handled, and sent."""

from __future__ import annotations

import contextlib
import os
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

    Signals that are ignored, as by `nohup`, are left alone; so are handled ones but Ctrl+C.
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
def noted_interrupts() -> Iterator[list[int]]:
    """Give a list that gets an entry at each Ctrl-C, which still raises KeyboardInterrupt.

    Packages that are interrupted while they are imported may raise something else.
    """
    noted: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        raise KeyboardInterrupt

    with handle_signals(stop, ["SIGINT"]):
        yield noted


@contextmanager
def endings_interrupt() -> Iterator[None]:
    """Let SIGTERM and SIGHUP be as Ctrl-C while the block runs."""
    with (
        handle_signals(signal.default_int_handler, ["SIGTERM"]),
        handle_signals(lambda *_: signal.raise_signal(signal.SIGTERM), ["SIGHUP"]),
    ):
        yield


@contextmanager
def sigterm_kept() -> Iterator[None]:
    """Undo what native code that the block loads does to SIGTERM, which Python does not know."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@contextmanager
def signals_held() -> Iterator[None]:
    """Let Ctrl-C wait while the block starts processes, in them for `end_worker_by_signals`."""
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


def end_by_interrupt() -> None:
    """Let Ctrl-C end this process at once, without KeyboardInterrupt."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def end_worker_by_signals() -> None:
    """Let Ctrl-C, which `signals_held` has held, and SIGTERM end a worker by SystemExit.

    It cleans up what its task holds open.
    """
    both = (signal.SIGINT, signal.SIGTERM)

    def end(number: int, frame: FrameType | None) -> None:
        for name in both:  # both may come
            signal.signal(name, signal.SIG_IGN)
        raise SystemExit

    for name in both:
        signal.signal(name, end)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def kill_group(process: int = 0) -> None:
    """Kill the group of a process, of this one by default; nothing where there is no group."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process, signal.SIGKILL)
