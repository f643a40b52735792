"""Parallel work over processes and threads, and the memory for it.

Not joblib, whose workers finish their task when the parent is killed; not psutil, which knows no
limit of a container. What starts processes is imported where it is used: it takes a tenth of the
time and the memory of a detector that is ready.
"""

from __future__ import annotations

import ctypes
import os
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from .errors import DeepDetectError, OptionError

if TYPE_CHECKING:
    from concurrent.futures import Future, ProcessPoolExecutor

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

PARTS_PER_THREAD = 4
"""More than one, so that a thread with easy parts takes more of them."""

UNWANTED_TASK_S = 20.0
"""How long a task may go on after the work was interrupted or has failed."""

DEFAULT_MEMORY = 4_000_000_000
"""Bytes assumed where the system does not say."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What libraries take the number of their threads from when they are loaded."""

_max_threads: int | None = None
"""Of this process, in `parallel_for`; None: one per processor."""

# M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD of malloc.h: no mappings, no trimming, room for more.
_MALLOPT = ((-4, 0), (-1, -1), (-2, 2**28))
_MMAP_THRESHOLD = (-3, 2**20)  # M_MMAP_THRESHOLD


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
    count = min(workers or processor_count(), len(tasks), 61)  # Windows waits for 63 at most
    if count <= 1:
        with _one_opencv_thread():
            yield from map(function, tasks)
        return
    import importlib.util
    import multiprocessing
    from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool

    from .opencv import import_opencv

    if importlib.util.find_spec("cv2") is None:
        import_opencv()  # says so here, and not in workers that cannot start
    # Spawned, not forked: a fork copies the locks of the parent's threads.
    context = multiprocessing.get_context("spawn")
    ended = context.Event()
    pool = ProcessPoolExecutor(
        count, mp_context=context, initializer=_start_worker, initargs=(ended,)
    )
    remaining = iter(tasks)

    def submit(places: Iterable[object]) -> set[Future[Outcome]]:
        with _interrupts_held(), _one_thread_inherited():  # by the processes that are started
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
    workers = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    deadline = time.monotonic() + UNWANTED_TASK_S
    while any(worker.is_alive() for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    for worker in workers:
        worker.kill()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait while processes are started, and in these until `_start_worker`."""
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


@contextmanager
def _one_thread_inherited() -> Iterator[None]:
    """Let libraries in processes that are started take one thread, unless the user says more."""
    unset = [name for name in _THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, "1"))
    try:
        yield
    finally:
        for name in unset:
            os.environ.pop(name, None)


class _Interrupts:
    """What Ctrl-C, which all processes of a terminal get, does to a worker: it ends its task."""

    ended: Any = None  # the event that no further task is wanted
    at_work = False
    stopped = False

    def handle(self, number: int, frame: FrameType | None) -> None:
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


_interrupts = _Interrupts()


def _run_task(function: Callable[[Task], Outcome], task: Task) -> Outcome:
    return _interrupts.run(function, task)


def _start_worker(ended: Any) -> None:
    """Prepare a worker: one thread, freed memory is kept, and it ends with the parent."""
    _interrupts.ended = ended
    signal.signal(signal.SIGINT, _interrupts.handle)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    use_one_thread()
    disable_malloc_trim()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def use_one_thread() -> None:
    """Let OpenCV and `parallel_for` use one thread from now on: this process is one of many."""
    global _max_threads
    from .opencv import cv2

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
    from .opencv import cv2

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


def available_memory() -> int:
    """Return the memory in bytes that is available without swapping, within the container's limit.

    Example:
        >>> available_memory() > 0
        True
    """
    return min(_system_memory(), _container_memory())


def disable_malloc_trim() -> bool:
    """Let this process keep the memory that it frees, where the C library is glibc.

    By default glibc returns large blocks to the system at once, and each page of the next ones is
    cleared again: a fifth of the time of a training step on the CPU, a sixth of that of labelling.
    The memory of the process then stays at its peak.

    Returns:
        Whether it has an effect.

    Example:
        >>> disable_malloc_trim() in (True, False)
        True
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) for option, value in _MALLOPT)


def release_freed_memory() -> bool:
    """Return freed memory to the system, now and, in blocks of a megabyte, from now on.

    The C library glibc keeps blocks of up to 32 MB otherwise, of which a network leaves hundreds of
    megabytes. It is a setting of the whole process.

    Returns:
        Whether it has an effect.

    Example:
        >>> release_freed_memory() in (True, False)
        True
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    library = ctypes.CDLL(None)
    library.malloc_trim(0)
    return bool(library.mallopt(*_MMAP_THRESHOLD))


def _system_memory() -> int:
    try:
        # MemAvailable includes caches that the system can drop; macOS lacks the file.
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return DEFAULT_MEMORY


def _container_memory() -> int:
    """Return what the control group (version 2) of a container leaves to this process."""
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        return 2**62 if limit == "max" else max(int(limit) - used, 0)
    except (OSError, ValueError):
        return 2**62
