"""Parallel work over processes and threads.

Not joblib, whose workers finish their task when the parent is killed. What starts processes is
imported where it is used: it takes a tenth of the time and the memory of a detector that is ready.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from .errors import DeepDetectError, OptionError
from .memory import disable_malloc_trim
from .opencv import cv2
from .signals import signals_held

if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

PARTS_PER_THREAD = 4
"""More than one, so that a thread with easy parts takes more of them."""

UNWANTED_TASK_S = 20.0
"""How long a task may go on after the work was interrupted or has failed."""

MAX_PROCESSES = 61
"""Windows waits for 63 at most."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries take the number of their threads from when they are loaded."""

_max_threads: int | None = None
"""Of this process, in `parallel_for`; None: one per processor."""


class TaskMap(Protocol):
    """Applies a function to many tasks: `map_in_processes`, or what does the same on a cluster."""

    def __call__(
        self,
        function: Callable[[Task], Outcome],
        tasks: Sequence[Task],
        workers: int | None = None,
    ) -> Iterator[Outcome]:
        """Yield the outcome of each task once, in the order in which they are ready."""
        ...


def processor_count() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_in_processes(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[Outcome]:
    """Apply a function to every task in several processes.

    Args:
        function: a module-level function; it runs on one thread.
        tasks: its arguments, which are pickled for the workers.
        workers: number of processes; default one per processor. With 1 the work is done in this
            process.

    Yields:
        The outcomes, in the order in which they are ready.

    Raises:
        OptionError: `workers` is below 1.
        DeepDetectError: a worker process died.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"workers must be at least 1, not {workers}")
    count = min(workers or processor_count(), len(tasks), MAX_PROCESSES)
    if count <= 1:
        with _one_opencv_thread():
            yield from map(function, tasks)
        return
    import multiprocessing
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool

    # Spawned, not forked: a fork copies the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    ended = context.Event()
    pool = ProcessPoolExecutor(
        count, mp_context=context, initializer=_start_worker, initargs=(ended,)
    )
    remaining = iter(tasks)

    def submit(places: Iterable[object]) -> set[Future[Outcome]]:
        # By the processes that are started, until `_start_worker`.
        with signals_held(), _one_thread_inherited():
            return {
                pool.submit(_run_task, function, task)
                for _, task in zip(places, remaining, strict=False)
            }

    pending: set[Future[Outcome]] = set()
    try:
        pending = submit(range(4 * count))
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
            pending |= submit(done)
    except BrokenProcessPool:
        raise DeepDetectError(
            "a worker process died, most likely for lack of memory: "
            "use fewer `workers`, or smaller images"
        ) from None
    finally:
        ended.set()  # some are queued where they cannot be cancelled
        if pending:
            _end_soon(pool)
        pool.shutdown(cancel_futures=True)


def _end_soon(pool: ProcessPoolExecutor) -> None:
    """Wait a while for tasks that nobody wants any more, then kill the processes.

    A signal to this process alone does not reach them. What they write is under temporary names
    until it is whole.
    """
    workers = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    deadline = time.monotonic() + UNWANTED_TASK_S
    while any(worker.is_alive() for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    for worker in workers:
        worker.kill()


@contextmanager
def _one_thread_inherited() -> Iterator[None]:
    """Let libraries in processes that are started take one thread, unless the user says more."""
    unset = [name for name in _THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        yield
    finally:
        for name in unset:
            del os.environ[name]


class _Worker:
    """What Ctrl-C, which all processes of a terminal get, does to a worker: it ends its task."""

    ended: Any = None  # the event that no further task is wanted
    at_work = False
    stopped = False

    def interrupt(self, number: int, frame: FrameType | None) -> None:
        """Remember the signal; where a task is done, end it."""
        self.stopped = True
        if self.at_work:
            raise KeyboardInterrupt

    def run(self, function: Callable[[Task], Outcome], task: Task) -> Outcome:
        """Do a task, unless the work has been stopped."""
        if self.stopped or self.ended.is_set():
            from concurrent.futures import CancelledError

            raise CancelledError
        self.at_work = True
        try:
            return function(task)
        finally:
            self.at_work = False


_worker = _Worker()


def _run_task(function: Callable[[Task], Outcome], task: Task) -> Outcome:
    return _worker.run(function, task)


def _start_worker(ended: Any) -> None:
    """Prepare a worker: one thread, freed memory is kept, and it ends with the parent."""
    _worker.ended = ended
    start_child(_worker.interrupt)
    disable_malloc_trim()


def start_child(on_interrupt: Any = signal.SIG_DFL) -> None:
    """Prepare a process that has been started: one thread, and it ends with its parent.

    Args:
        on_interrupt: what Ctrl-C does, as for `signal.signal`.
    """
    signal.signal(signal.SIGINT, on_interrupt)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    use_one_thread()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def use_one_thread() -> None:
    """Let OpenCV and `parallel_for` use one thread from now on: this process is one of many."""
    global _max_threads
    cv2.setNumThreads(1)
    _max_threads = 1


def _end_with_parent() -> None:
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def parallel_for(count: int, work: Callable[..., object], *arguments: Any) -> None:
    """Call a function for parts of a range, in as many threads as there are processors.

    In a worker of `map_in_processes` it is one thread.

    Args:
        count: length of the range.
        work: called with (start, stop, *arguments) for each part. It should release the GIL, and
            its result must not depend on how the range is divided.
        arguments: the same for all parts.

    Example:
        >>> done = []
        >>> parallel_for(10, lambda start, stop: done.extend(range(start, stop)))
        >>> sorted(done) == list(range(10))
        True
    """
    threads = min(_max_threads or processor_count(), count)
    if threads <= 1:
        work(0, count, *arguments)
        return
    from concurrent.futures import ThreadPoolExecutor

    parts = min(count, threads * PARTS_PER_THREAD)
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work, *edge, *arguments) for edge in pairwise(edges)]:
            future.result()
