"""Processors and memory of this machine: parallel work, and how much memory is free.

joblib is not used, because its workers finish their task when the parent is killed. Modules that
start processes are imported late: they take a tenth of the time and memory of loading a detector.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from .errors import DeepDetectError, OptionError
from .opencv import cv2
from .signals import end_by_interrupt, end_worker_by_signals, signals_held

if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor
    from multiprocessing.process import BaseProcess

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

PARTS_PER_THREAD = 4
"""Average number of parts per thread. A thread whose parts are easy takes more of them."""

TASKS_PER_WORKER = 8
"""`map_in_processes` submits this number of tasks per worker ahead, so that the others stay busy
while it waits for the outcome of the first. Chosen by hand."""

UNWANTED_TASK_S = 20.0
"""Seconds that a running task has to end after the work was interrupted or failed, before it is
killed."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables from which libraries take their number of threads when they are loaded."""

BYTES_PER = {
    # Descriptors, and the search trees of a matcher.
    "matched_keypoint": 1500,
    # Blending of a panorama: a pixel of the canvas, and of the box of one image on it.
    "canvas_pixel": 34,
    "blended_pixel": 30,
    # Two maps of float32, and arrays derived from them.
    "pixel_of_level": 16,
    # Peak of dense matching.
    "dense_pixel": 250,
    "fused_pixel": 500,
}
"""Bytes of memory per item, as measured; `needed_memory` adds them up."""

DEFAULT_MEMORY = 4_000_000_000
"""Bytes assumed to be available if the system does not tell."""

# M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h: no mappings, no trimming, larger growth.
_MALLOPT = ((-4, 0), (-1, -1), (-2, 2**28))
_MMAP_THRESHOLD = (-3, 2**20)  # M_MMAP_THRESHOLD

_max_threads: int | None = None
"""`parallel_for` uses at most this number of threads in this process; None: one per processor."""

_chosen = threading.local()
"""Number of threads that a caller has chosen for the duration of a call."""


TaskMap = Callable[..., Iterator[Any]]
"""Type of `map_in_processes`, and of functions that do the same on a cluster."""


def processor_count() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_in_processes(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[Outcome]:
    """Apply a module-level function to every task, in several processes.

    Outcomes are in the order of the tasks. With one worker, the work is done in this process.

    Raises:
        OptionError: `workers` is below 1.
        DeepDetectError: a worker process died.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"`workers` must be at least 1, not {workers}")
    most = 61 if os.name == "nt" else len(tasks)  # Windows cannot wait for more processes
    count = min(workers or processor_count(), most, len(tasks))
    if count <= 1:
        with one_opencv_thread():
            yield from map(function, tasks)
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # A forked process would copy the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    remaining = iter(tasks)

    pending: deque[Future[Outcome]] = deque()

    def submit(most: int) -> None:
        # The first submissions start processes, which inherit the blocked signal and one thread.
        with signals_held(), _one_thread_inherited():
            for task in islice(remaining, most):
                pending.append(pool.submit(_run_task, function, task))

    try:
        submit(TASKS_PER_WORKER * count)
        while pending:
            yield pending.popleft().result()
            submit(1)
    except BrokenProcessPool:
        raise DeepDetectError(
            "a worker process died, probably for lack of memory: use fewer `workers`, or smaller "
            "images"
        ) from None
    finally:
        if pending:
            _end_workers(pool)
        pool.shutdown(cancel_futures=True)


def _end_workers(pool: ProcessPoolExecutor) -> None:
    """End tasks that are no longer needed: they clean up, or are killed after a while."""
    workers = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for worker in workers:
        worker.terminate()
    deadline = time.monotonic() + UNWANTED_TASK_S
    for worker in workers:
        worker.join(max(0.0, deadline - time.monotonic()))
        worker.kill()


@contextmanager
def _one_thread_inherited() -> Iterator[None]:
    """Let libraries in new processes use one thread, unless the user has set a number."""
    unset = [name for name in _THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        yield
    finally:
        for name in unset:
            del os.environ[name]


def _run_task(function: Callable[[Task], Outcome], task: Task) -> Outcome:
    try:
        end_worker_by_signals()
        return function(task)
    except SystemExit:  # else the pool would run the next task
        os._exit(1)


def _start_worker() -> None:
    start_child()
    disable_malloc_trim()


def start_child() -> None:
    """Prepare a new process: it uses one thread, and ends with its parent."""
    end_by_interrupt()
    use_one_thread()
    end_with_parent()


def use_one_thread() -> None:
    """Let OpenCV and `parallel_for` use one thread in this process from now on."""
    global _max_threads
    cv2.setNumThreads(1)
    _max_threads = 1


@contextmanager
def limited_threads(threads: int | None) -> Iterator[None]:
    """Limit the threads used by calls from this thread while the block runs; None: no limit."""
    before = getattr(_chosen, "threads", None)
    _chosen.threads = threads or before
    try:
        yield
    finally:
        _chosen.threads = before


def thread_limit() -> int | None:
    """Return how many threads this process may use, or None for a library's own number.

    OMP_NUM_THREADS is respected. Worker processes, and processes that may not use all processors,
    get a number: by default ONNX Runtime binds threads to the same processors in every process.
    """
    if chosen := getattr(_chosen, "threads", None):
        return int(chosen)
    # A process that multiprocessing started has loaded the module; others need not import it.
    parent_of = getattr(sys.modules.get("multiprocessing.process"), "parent_process", None)
    wished = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    if _max_threads is None and wished.isdecimal() and int(wished):
        return int(wished)
    if _max_threads is None and (
        (parent_of and parent_of()) or processor_count() < (os.cpu_count() or 1)
    ):
        return processor_count()
    return _max_threads


def end_with_parent(end: Callable[[], object] = lambda: None) -> None:
    """End this process when its parent has ended, after a last call of `end`."""
    import multiprocessing

    def wait(parent: BaseProcess) -> None:
        parent.join()
        end()
        os._exit(1)

    if parent := multiprocessing.parent_process():
        threading.Thread(target=wait, args=[parent], daemon=True).start()


@contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Let OpenCV use one thread while the block runs."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def parallel_for(count: int, work: Callable[..., object], *arguments: Any) -> None:
    """Call `work(start, stop, *arguments)` for parts of a range, in a thread for each processor.

    `work` should release the GIL, and its result must not depend on how the range is divided. A
    worker of `map_in_processes` uses one thread.
    """
    threads = min(thread_limit() or processor_count(), count)
    if threads <= 1:
        work(0, count, *arguments)
        return
    from concurrent.futures import ThreadPoolExecutor

    parts = min(count, threads * PARTS_PER_THREAD)
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work, *edge, *arguments) for edge in pairwise(edges)]:
            future.result()


def available_memory() -> int:
    """Return the bytes that are available without swapping, within the container's limit."""
    return min(_system_memory(), _container_memory())


def needed_memory(**counts: float) -> float:
    """Return the bytes that a step needs for `counts` of items, named as in `BYTES_PER`."""
    return sum(BYTES_PER[name] * count for name, count in counts.items())


def require_memory(what: str, advice: str, **counts: float) -> None:
    """Check that a step does not exceed the memory; `counts` are as in `needed_memory`.

    Raises:
        OptionError: the step needs more memory than is available.
    """
    needed = needed_memory(**counts)
    if needed > available_memory():
        raise OptionError(
            f"{what} need about {needed / 1e9:.2g} GB of memory, but less is free: {advice}"
        )


def disable_malloc_trim() -> None:
    """Let this process keep the memory that it frees, if the C library is glibc.

    By default glibc returns large blocks to the system at once, which then clears each page of new
    ones. This takes a fifth of the time of a training step on the CPU, and a sixth of labelling.
    """
    if platform.libc_ver()[0] == "glibc":
        for option, value in _MALLOPT:
            ctypes.CDLL(None).mallopt(option, value)


def release_freed_memory() -> None:
    """Return freed memory to the system now, and blocks of a megabyte or more from now on.

    By default, glibc keeps blocks of up to 32 MB, so that a network leaves hundreds of megabytes
    behind. The setting is for the whole process.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
        library.mallopt(*_MMAP_THRESHOLD)


def _system_memory() -> int:
    # MemAvailable includes caches that the system can drop.
    with suppress(OSError, StopIteration):  # macOS does not have this file
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvail"))
    with suppress(AttributeError, ValueError):  # Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return DEFAULT_MEMORY


def _container_memory() -> int:
    """Return the bytes that the control group (version 2) of a container leaves to this process."""
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError, KeyError):  # no control group, or its limit is "max"
        limit, used, stat = (
            (group / f"memory.{name}").read_text() for name in ("max", "current", "stat")
        )
        cached = dict(line.split() for line in stat.splitlines())["inactive_file"]  # can be dropped
        return max(int(limit) - int(used) + int(cached), 0)
    return 2**62
