"""The processors and the memory of this machine: parallel work, and what is free for it.

Not joblib, whose workers finish their task when the parent is killed. What starts processes is
imported where it is used: it takes a tenth of the time and the memory of a detector that is ready.
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
"""More than one, so that a thread with easy parts takes more of them."""

TASKS_PER_WORKER = 8
"""Of `map_in_processes` that are given out at a time: others are done while the first one lasts."""

UNWANTED_TASK_S = 20.0
"""How long a task may take to end after the work was interrupted or has failed."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries take the number of their threads from when they are loaded."""

BYTES_PER = {
    # Descriptors, and the search trees of a matcher.
    "matched_keypoint": 1500,
    # Blending a panorama: a pixel of the canvas, and of the box of one image on it.
    "canvas_pixel": 34,
    "blended_pixel": 30,
    # Two maps of float32, and room for what is made of them.
    "pixel_of_level": 16,
    # Dense matching, at its peak.
    "dense_pixel": 250,
    "fused_pixel": 500,
}
"""Measured; `needed_memory` adds them up."""

DEFAULT_MEMORY = 4_000_000_000
"""Bytes assumed where the system does not say."""

# M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h: no mappings, no trimming, room for more.
_MALLOPT = ((-4, 0), (-1, -1), (-2, 2**28))
_MMAP_THRESHOLD = (-3, 2**20)  # M_MMAP_THRESHOLD

_max_threads: int | None = None
"""The most threads that `parallel_for` uses in this process; None: one for each processor."""

_chosen = threading.local()
"""The number of threads that a caller has chosen, while its call runs."""


TaskMap = Callable[..., Iterator[Any]]
"""`map_in_processes`, or what does the same on a cluster."""


def processor_count() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def map_in_processes(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[Outcome]:
    """Apply a function of a module to every task, one in each of several processes at a time.

    Outcomes are in the order of the tasks.

    Raises:
        OptionError: `workers` is below 1; with 1 the work is done in this process.
        DeepDetectError: a worker process died.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"`workers` must be at least 1, not {workers}")
    most = 61 if os.name == "nt" else len(tasks)  # Windows cannot wait for more
    count = min(workers or processor_count(), most, len(tasks))
    if count <= 1:
        with one_opencv_thread():
            yield from map(function, tasks)
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # Spawned, not forked: a fork copies the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    remaining = iter(tasks)

    pending: deque[Future[Outcome]] = deque()

    def submit(most: int) -> None:
        # By the processes that are started, until their first task.
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
            "a worker process died, most likely for lack of memory: "
            "use fewer `workers`, or smaller images"
        ) from None
    finally:
        if pending:
            _end_workers(pool)
        pool.shutdown(cancel_futures=True)


def _end_workers(pool: ProcessPoolExecutor) -> None:
    """End tasks that nobody wants any more: they clean up, or are killed after a while."""
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
    """Let libraries in processes that are started take one thread, unless the user says more."""
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
    except SystemExit:  # the pool would go on with the next task
        os._exit(1)


def _start_worker() -> None:
    start_child()
    disable_malloc_trim()


def start_child() -> None:
    """Prepare a process that has been started: one thread, and it ends with its parent."""
    end_by_interrupt()
    use_one_thread()
    end_with_parent()


def use_one_thread() -> None:
    """Let OpenCV and `parallel_for` use one thread from now on: this process is one of many."""
    global _max_threads
    cv2.setNumThreads(1)
    _max_threads = 1


@contextmanager
def limited_threads(threads: int | None) -> Iterator[None]:
    """Let what this thread calls use at most this many threads while the block runs; None: all."""
    before = getattr(_chosen, "threads", None)
    _chosen.threads = threads or before
    try:
        yield
    finally:
        _chosen.threads = before


def thread_limit() -> int | None:
    """Return how many threads this process may use, by OMP_NUM_THREADS too; None: a library's own.

    ONNX Runtime's own are bound to processors, in every process to the same ones and also to those
    that the process may not use: a process that is one of several is given a number.
    """
    if chosen := getattr(_chosen, "threads", None):
        return int(chosen)
    # Who was started by it has it; others need not load it.
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
    """End this process when the one that started it has ended, after a last call."""
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
    """Call `work(start, stop, *arguments)` for parts of a range, in as many threads as processors.

    It should release the GIL, and its result must not depend on how the range is divided. In a
    worker of `map_in_processes` it is one thread.
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
    """Return the bytes that a step takes; `counts` by the names of `BYTES_PER`."""
    return sum(BYTES_PER[name] * count for name, count in counts.items())


def require_memory(what: str, advice: str, **counts: float) -> None:
    """Refuse a step that would fill the memory; `counts` as of `needed_memory`.

    Raises:
        OptionError: more is needed than is available.
    """
    needed = needed_memory(**counts)
    if needed > available_memory():
        raise OptionError(
            f"{what} need about {needed / 1e9:.2g} GB of memory, more than is free: {advice}"
        )


def disable_malloc_trim() -> None:
    """Let this process keep the memory that it frees, where the C library is glibc.

    By default glibc returns large blocks to the system at once, and each page of the next ones is
    cleared again: a fifth of the time of a training step on the CPU, a sixth of that of labelling.
    """
    if platform.libc_ver()[0] == "glibc":
        for option, value in _MALLOPT:
            ctypes.CDLL(None).mallopt(option, value)


def release_freed_memory() -> None:
    """Return freed memory to the system, now and, in blocks of a megabyte, from now on.

    The C library glibc keeps blocks of up to 32 MB otherwise, of which a network leaves hundreds of
    megabytes. It is a setting of the whole process.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
        library.mallopt(*_MMAP_THRESHOLD)


def _system_memory() -> int:
    # MemAvailable includes caches that the system can drop.
    with suppress(OSError, StopIteration):  # macOS lacks the file
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvail"))
    with suppress(AttributeError, ValueError):  # Windows
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return DEFAULT_MEMORY


def _container_memory() -> int:
    """Return what the control group (version 2) of a container leaves to this process."""
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError, KeyError):  # there is none, or its limit is "max"
        limit, used, stat = (
            (group / f"memory.{name}").read_text() for name in ("max", "current", "stat")
        )
        cached = dict(line.split() for line in stat.splitlines())["inactive_file"]  # can be dropped
        return max(int(limit) - int(used) + int(cached), 0)
    return 2**62
