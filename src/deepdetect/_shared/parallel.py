"""Parallel work over processes and threads, and the memory for it."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import platform
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from .errors import DeepDetectError, OptionError

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")

PARTS_A_THREAD = 4
"""Parts are more than threads, so that a thread with easy ones takes more of them."""

UNKNOWN = 4_000_000_000
"""Bytes assumed where the system does not tell."""

# Of malloc.h: no block of its own mapping, nothing given back at the end, room for more.
_KEEP = ((-4, 0), (-1, -1), (-2, 2**28))


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
            "use fewer `workers`, or smaller images"
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


def parallel_for(count: int, work: Callable[..., object], *arguments: Any) -> None:
    """Do a piece of work on parts of a range, in as many threads as there are processors.

    The parts do not depend on the number of threads as far as the work is concerned: it must
    give the same for a range as for its parts.

    Args:
        count: length of the range.
        work: called with (start, stop, *arguments) for each part; it should release Python's lock.
        arguments: the same for all parts.

    Example:
        >>> done = []
        >>> parallel_for(10, lambda start, stop: done.extend(range(start, stop)))
        >>> sorted(done) == list(range(10))
        True
    """
    threads = min(processor_count(), count)
    if threads <= 1:
        work(0, count, *arguments)
        return
    parts = min(count, threads * PARTS_A_THREAD)
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work, *edge, *arguments) for edge in pairwise(edges)]:
            future.result()


def available_memory() -> int:
    """Return the memory in bytes that can be had without swapping, within the container's limit.

    Example:
        >>> available_memory() > 0
        True
    """
    return min(_system_memory(), _container_memory())


def disable_malloc_trim() -> bool:
    """Let this process keep what it frees, for its next arrays, as far as the system can do that.

    The GNU library gives large blocks back at once, and the system clears each page of the
    next ones anew: a training step on the CPU, which makes and frees gigabytes, spends a fifth
    of its time on that. It holds for the whole process, whose memory stays at its peak.

    Returns:
        Whether it will be so.

    Example:
        >>> disable_malloc_trim() in (True, False)
        True
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return all(mallopt(option, value) for option, value in _KEEP)


def _system_memory() -> int:
    try:
        # MemAvailable counts the caches that the system would give up; macOS lacks the file.
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return UNKNOWN


def _container_memory() -> int:
    """Return what a control group (version 2) leaves to this process."""
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        return 2**62 if limit == "max" else max(int(limit) - used, 0)
    except (OSError, ValueError):
        return 2**62
