"""Work over threads for compiled functions that let go of Python's lock."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

from .processes import processor_count

PARTS_A_THREAD = 4
"""Parts are more than threads, so that a thread with easy ones takes more of them."""


def in_threads(count: int, work: Callable[[int, int], object]) -> None:
    """Do a piece of work on parts of a range, in as many threads as there are processors.

    The parts do not depend on the number of threads as far as the work is concerned: it must
    give the same for a range as for its parts.

    Args:
        count: length of the range.
        work: called with (start, stop) of each part; it should release Python's lock.

    Example:
        >>> done = []
        >>> in_threads(10, lambda start, stop: done.extend(range(start, stop)))
        >>> sorted(done) == list(range(10))
        True
    """
    threads = min(processor_count(), count)
    if threads <= 1:
        work(0, count)
        return
    parts = min(count, threads * PARTS_A_THREAD)
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work, *edge) for edge in pairwise(edges)]:
            future.result()
