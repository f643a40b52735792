"""Processors and memory of this machine: parallel work, and how much memory is free.

joblib is not used, because its workers finish their task even if the parent is killed.
multiprocessing is imported only when needed, because its import takes time and memory.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
import threading
import time
import warnings
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

PARTS_PER_THREAD, TASKS_PER_WORKER = 4, 8
"""`parallel_for` divides work into PARTS_PER_THREAD parts per thread, and `map_in_processes` queues
TASKS_PER_WORKER tasks per worker, so that no thread or worker idles. Chosen by hand."""

UNWANTED_TASK_S = 20.0
"""Workers still alive this many seconds after a failure or Ctrl-C are killed. Chosen by hand."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that set the number of threads of libraries when they are loaded."""

BYTES_PER = {
    # A keypoint's descriptor, and the keypoint's part of a matcher's search trees.
    "matched_keypoint": 1500,
    # Blending a panorama: a pixel of its canvas, and a pixel of the largest warped image.
    "canvas_pixel": 34,
    "blended_pixel": 30,
    # A pixel of a scale-space level: two float32 maps, and arrays derived from them.
    "pixel_of_level": 12,
    # A pixel of an image in dense matching, and of a depth map in the fusion of depth maps.
    "dense_pixel": 250,
    "fused_pixel": 500,
}
"""Bytes of memory per item, as measured; `needed_memory` multiplies them by numbers of items."""

# Options of glibc's `mallopt` that keep freed memory: with M_MMAP_MAX = 0 every block is part of
# the heap, M_TRIM_THRESHOLD = -1 never trims it, and M_TOP_PAD lets it grow in steps of 256 MB.
_MALLOPT = ((-4, 0), (-1, -1), (-2, 2**28))
_MMAP_THRESHOLD = (-3, 2**20)  # M_MMAP_THRESHOLD: blocks from 1 MB on are mapped separately

_max_threads: int | None = None
"""`parallel_for` uses at most this number of threads in this process; None: one per processor."""


class _Chosen(threading.local):
    threads: int | None = None


_chosen = _Chosen()
"""The attribute `threads` is the limit that `limited_threads` has set in the current thread."""

TaskMap = Callable[..., Iterator[Any]]
"""Type of `map_in_processes`, and of functions that do the same on a cluster."""


@contextmanager
def temporarily(target: object, **values: Any) -> Iterator[None]:
    """Set attributes of an object, such as the settings of a library, while the block runs."""
    before = {name: getattr(target, name) for name in values}
    for name, value in values.items():
        setattr(target, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(target, name, value)


def processor_count() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name() -> str:
    """Return the marketing name of the processor if the system knows it."""
    with suppress(OSError, IndexError):
        return re.findall(r"model name\s*: (.+)", Path("/proc/cpuinfo").read_text())[0]
    return platform.processor() or platform.machine()


def map_in_processes(
    function: Callable[[Task], Outcome], tasks: Sequence[Task], workers: int | None = None
) -> Iterator[Outcome]:
    """Apply a module-level function to every task, in several processes; yield the outcomes.

    Outcomes are in the order of the tasks. With one worker, the work is done in this process.

    Raises:
        OptionError: `workers` is below 1.
        DeepDetectError: a worker process died.
    """
    if workers is not None and workers < 1:
        raise OptionError(f"`workers` must be at least 1, not {workers}")
    most = 61 if os.name == "nt" else len(tasks)  # Windows cannot wait for more than 61 processes
    count = min(workers or processor_count(), most, len(tasks))
    if count <= 1:
        with one_opencv_thread():
            yield from map(function, tasks)
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool

    # A forked process would copy locks held by the parent's threads, and wait for them forever.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker)
    remaining = iter(tasks)
    pending: deque[Future[tuple[Outcome, list[str]]]] = deque()

    def submit(most: int) -> None:
        # Processes start at the first submissions, so they inherit deferred Ctrl-C and one thread.
        with signals_held(), _one_thread_inherited():
            for task in islice(remaining, most):
                pending.append(pool.submit(_run_task, function, task))

    try:
        submit(TASKS_PER_WORKER * count)
        while pending:
            yield told(pending.popleft().result())
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
    """Let workers end and clean up; kill those that have not ended after `UNWANTED_TASK_S`."""
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
    """Start processes in the block with one thread per library, unless the user set a number."""
    unset = [name for name in _THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        yield
    finally:
        for name in unset:
            del os.environ[name]


def recorded(function: Callable[[Task], Outcome], task: Task) -> tuple[Outcome, list[str]]:
    """Run a task; return its outcome and its user warnings, which `told` repeats later."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        outcome = function(task)
    return outcome, [str(each.message) for each in caught if each.category is UserWarning]


def told(done: tuple[Outcome, list[str]]) -> Outcome:
    """Return an outcome of `recorded`, and repeat its warnings."""
    for text in done[1]:
        warnings.warn(text, UserWarning, stacklevel=3)
    return done[0]


def _run_task(function: Callable[[Task], Outcome], task: Task) -> tuple[Outcome, list[str]]:
    try:
        end_worker_by_signals()
        return recorded(function, task)
    except SystemExit:  # otherwise the process would run the next task
        os._exit(1)


def _start_worker() -> None:
    start_child()
    disable_malloc_trim()


def start_child() -> None:
    """Let this new process use one thread, and end with its parent or at Ctrl-C."""
    end_by_interrupt()
    use_one_thread()
    end_with_parent()


def use_one_thread() -> None:
    """Let OpenCV and `parallel_for` use one thread in this process from now on."""
    global _max_threads
    cv2.setNumThreads(1)
    _max_threads = 1


@contextmanager
def limited_threads(threads: int | None = None) -> Iterator[None]:
    """Limit how many threads each call in the block uses; None sets no new limit.

    NumPy's matrix products use one thread: several threads would mostly wait for each other,
    because the matrices are small.
    """
    from threadpoolctl import threadpool_limits

    limited = temporarily(_chosen, threads=threads or _chosen.threads)
    with limited, threadpool_limits(1, user_api="blas"):
        yield


def thread_limit() -> int | None:
    """Return how many threads this process may use, or None to let each library decide.

    OMP_NUM_THREADS is respected. Child processes, and processes that may not use all processors,
    always get a number, because by default ONNX Runtime binds its threads to the same processors
    in every process.
    """
    if _chosen.threads:
        return _chosen.threads
    if _max_threads is not None:
        return _max_threads
    wished = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    if wished.isdecimal() and int(wished):
        return int(wished)
    # multiprocessing is not imported for this: its own child processes have imported it already.
    parent_of = getattr(sys.modules.get("multiprocessing.process"), "parent_process", None)
    is_child = parent_of and parent_of()
    return processor_count() if is_child or processor_count() < (os.cpu_count() or 1) else None


def end_with_parent(end: Callable[[], object] = lambda: None) -> None:
    """When the parent process has ended, call `end`, then end this process."""
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
    """Call `work(start, stop, *arguments)` for parts of range(count), with a thread per processor.

    `work` should release the GIL, and its result must not depend on how the range is divided. In a
    worker process of `map_in_processes`, there is only one thread.
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
    """Return the bytes of memory available without swapping, within the container's limit."""
    return min(_system_memory(), _container_memory())


def needed_memory(**counts: float) -> float:
    """Return the bytes that a step needs for given numbers of items, named as in `BYTES_PER`."""
    return sum(BYTES_PER[name] * count for name, count in counts.items())


def require_memory(what: str, advice: str, **counts: float) -> None:
    """Raise an OptionError if a step needs more memory than is available; see `needed_memory`."""
    needed = needed_memory(**counts)
    if needed > available_memory():
        raise OptionError(
            f"{what} need about {needed / 1e9:.2g} GB of memory, but less is free: {advice}"
        )


def disable_malloc_trim() -> None:
    """Let this process keep the memory that it frees, if the C library is glibc.

    By default, glibc returns large freed blocks to the system, and new blocks must be cleared.
    Clearing takes a fifth of the time of a training step on the CPU.
    """
    if platform.libc_ver()[0] == "glibc":
        for option, value in _MALLOPT:
            ctypes.CDLL(None).mallopt(option, value)


def release_freed_memory() -> None:
    """Return all freed memory to the system, and from now on each freed block over a megabyte.

    By default, glibc keeps freed blocks of up to 32 MB for itself: hundreds of megabytes after a
    network has run. The setting applies to the whole process.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
        library.mallopt(*_MMAP_THRESHOLD)


def _system_memory() -> int:
    # MemAvailable includes caches that the system can drop.
    with suppress(OSError, StopIteration):  # macOS lacks /proc/meminfo
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvail"))
    with suppress(AttributeError, ValueError):  # Windows lacks `sysconf`
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return 4_000_000_000  # assumed if the system reports nothing


def _container_memory() -> int:
    """Return the free bytes below the limit of the container (cgroup v2), or 2**62 without one."""
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError, KeyError):  # no control group, or its limit is "max"
        limit, used, stat = (
            (group / f"memory.{name}").read_text() for name in ("max", "current", "stat")
        )
        cached = dict(line.split() for line in stat.splitlines())["inactive_file"]  # can be dropped
        return max(int(limit) - int(used) + int(cached), 0)
    return 2**62
