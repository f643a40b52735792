from __future__ import annotations

import threading
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared import threads
from deepdetect._shared.threads import in_threads


@given(count=st.integers(0, 200))
def test_each_number_is_done_once(count: int) -> None:
    done: list[int] = []
    in_threads(count, lambda start, stop: done.extend(range(start, stop)))
    assert sorted(done) == list(range(count))


def test_several_threads_work_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "processor_count", lambda: 3)
    together = threading.Barrier(3, timeout=20)
    waited: list[int] = []

    def work(start: int, stop: int) -> None:
        if start < 3:  # the first three parts of one number each
            together.wait()
            waited.append(start)

    in_threads(12, work)
    assert sorted(waited) == [0, 1, 2]


def test_an_error_in_a_part_is_the_callers() -> None:
    def work(start: int, stop: int) -> None:
        raise ZeroDivisionError("as it happens")

    with pytest.raises(ZeroDivisionError, match="as it happens"):
        in_threads(5, work)


def test_calls_from_several_threads_do_not_meet() -> None:
    results: dict[int, list[int]] = {}

    def call(number: int) -> Callable[[], None]:
        def run() -> None:
            done: list[int] = []
            in_threads(50, lambda start, stop: done.extend(range(start, stop)))
            results[number] = sorted(done)

        return run

    callers = [threading.Thread(target=call(number)) for number in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all(results[number] == list(range(50)) for number in range(4))
