from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.training.prefetch import prefetched


@given(st.lists(st.integers(), max_size=30), st.integers(1, 4), st.integers(1, 5))
def test_outcomes_come_in_order(tasks: list[int], threads: int, ahead: int) -> None:
    assert list(prefetched(lambda x: 2 * x, tasks, threads, ahead)) == [2 * x for x in tasks]


def test_no_more_than_wanted_is_made_ahead() -> None:
    made = []
    stream = prefetched(lambda k: made.append(k), range(100), 2, 3)
    next(stream)
    time.sleep(0.05)
    assert len(made) <= 4
    stream.close()


def test_threads_work_at_the_same_time() -> None:
    meeting = threading.Barrier(3)
    assert len(list(prefetched(lambda k: meeting.wait(5), range(3), 3, 3))) == 3


def test_an_error_is_raised_in_its_turn() -> None:
    def work(k: int) -> int:
        if k == 2:
            raise ValueError("broken")
        return k

    stream = prefetched(work, range(5), 2, 4)
    assert [next(stream), next(stream)] == [0, 1]
    with pytest.raises(ValueError, match="broken"):
        next(stream)
