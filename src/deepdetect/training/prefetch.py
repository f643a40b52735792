"""Work done ahead by threads, handed over in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Task = TypeVar("Task")
Outcome = TypeVar("Outcome")


def prefetched(
    function: Callable[[Task], Outcome], tasks: Iterable[Task], threads: int, ahead: int
) -> Iterator[Outcome]:
    """Apply a function to every task in threads, ahead of who takes the outcomes.

    Args:
        function: any function; an exception of it is raised where its outcome is taken.
        tasks: its arguments.
        threads: number of threads.
        ahead: how many outcomes are made or held ready at most.

    Yields:
        The outcomes, in the order of the tasks.

    Example:
        >>> list(prefetched(abs, [-1, 2, -3], threads=2, ahead=2))
        [1, 2, 3]
    """
    waiting: deque[Future[Outcome]] = deque()
    pool = ThreadPoolExecutor(threads, "prefetch")
    try:
        for task in tasks:
            waiting.append(pool.submit(function, task))
            if len(waiting) > ahead:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
