"""Parallel work over processes, one image a task."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import TypeVar

from .errors import DeepDetectError, OptionError

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


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
        function: a module-level function; it runs with one OpenCV thread.
        tasks: its arguments, to be pickled to the workers.
        workers: number of processes; default one for each processor. With 1 the
            work is done in this process.

    Yields:
        The outcomes, in the order in which they are ready.

    Raises:
        OptionError: `workers` is under 1.
        DeepDetectError: a worker process died.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"workers must be at least 1, not {workers}")
    count = min(workers or processor_count(), len(tasks), 61)  # Windows waits for 63 at most
    if count <= 1:
        with _one_opencv_thread():
            yield from map(function, tasks)
        return
    # Spawned, not forked: a fork copies the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    with _worker_environment():
        pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
        remaining = iter(tasks)
        # The first submissions start the processes, inside the environment above.
        pending = {
            pool.submit(function, task)
            for _, task in zip(range(4 * count), remaining, strict=False)
        }
    try:
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
            pending |= {
                pool.submit(function, task) for _, task in zip(done, remaining, strict=False)
            }
    except BrokenProcessPool:
        raise DeepDetectError(
            "a worker process died, most likely for lack of memory: "
            "use fewer --workers, or smaller images"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _worker_environment() -> Iterator[None]:
    """Let glibc keep freed memory in the workers.

    The detectors take and free large buffers for every image; getting them from
    the system anew each time costs a sixth of the whole labelling time.
    """
    wanted = {
        "MALLOC_TRIM_THRESHOLD_": "1000000000",
        "MALLOC_MMAP_THRESHOLD_": "1000000000",
    }
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update({name: value for name, value in wanted.items() if before[name] is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


def _start_worker() -> None:
    """Prepare a worker: one OpenCV thread, and an end when the parent is gone."""
    import cv2

    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
