"""Handling and sending of signals that ask a process to end; no other module does so."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

ENDING = ("SIGTERM", "SIGHUP")
"""Signals sent by `kill`, and by a terminal that is closed; Windows lacks SIGHUP."""


@contextmanager
def handle_signals(
    handler: Callable[[int, FrameType | None], object], names: Sequence[str] = ENDING
) -> Iterator[None]:
    """Handle signals by `handler` while the block runs; outside the main thread, do nothing.

    Signals that are ignored, as by `nohup`, stay ignored. A handler that the program has set stays,
    except the one for Ctrl-C.
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
    """Exit with 128 plus the signal's number, as shells do; a handler for `handle_signals`."""
    raise SystemExit(128 + number)


@contextmanager
def noted_interrupts() -> Iterator[list[int]]:
    """Yield a list that gets an entry at each Ctrl-C, which still raises KeyboardInterrupt.

    The list is needed because an interrupted import may hide that exception behind another one.
    """
    noted: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        noted.append(number)
        raise KeyboardInterrupt

    with handle_signals(stop, ["SIGINT"]):
        yield noted


@contextmanager
def endings_interrupt() -> Iterator[None]:
    """Treat SIGTERM and SIGHUP like Ctrl-C while the block runs."""
    with (
        handle_signals(signal.default_int_handler, ["SIGTERM"]),
        handle_signals(lambda *_: signal.raise_signal(signal.SIGTERM), ["SIGHUP"]),
    ):
        yield


@contextmanager
def sigterm_kept() -> Iterator[None]:
    """Restore the handler of SIGTERM after the block, because native code there may replace it."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@contextmanager
def signals_held() -> Iterator[None]:
    """Defer Ctrl-C while the block runs.

    Processes started in the block defer Ctrl-C until they call `end_worker_by_signals`.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    # Starting multiprocessing's resource tracker unblocks Ctrl-C, so it is started first.
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
    """Let SIGTERM and Ctrl-C end a worker process by SystemExit, even if Ctrl-C was deferred."""
    both = (signal.SIGINT, signal.SIGTERM)

    def end(number: int, frame: FrameType | None) -> None:
        for name in both:  # both signals may arrive
            signal.signal(name, signal.SIG_IGN)
        raise SystemExit

    for name in both:
        signal.signal(name, end)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])


def kill_group(process: int = 0) -> None:
    """Kill the process group of a process, by default of this one; on Windows, do nothing."""
    if hasattr(os, "killpg"):
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process, signal.SIGKILL)
