from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from deepdetect.errors import ImageError, OptionError
from deepdetect.image import load_image
from deepdetect.processes import map_in_processes, processor_count

# The workers import functions by name, so these tests send functions of installed modules.
PROBE = (
    "(__import__('os').getpid(), __import__('cv2').getNumThreads(),"
    " __import__('os').environ.get('MALLOC_TRIM_THRESHOLD_'))"
)


def test_outcomes_equal_serial_ones_and_the_environment_is_restored() -> None:
    tasks = list(range(25))  # more than the workers are given at first
    before = dict(os.environ)
    parallel = map_in_processes(math.factorial, tasks, workers=2)
    assert sorted(parallel) == [math.factorial(task) for task in tasks]
    assert dict(os.environ) == before


def test_workers_are_other_processes_with_one_thread() -> None:
    seen = list(map_in_processes(eval, [PROBE] * 6, workers=2))
    assert len(seen) == 6
    assert os.getpid() not in {pid for pid, _, _ in seen}
    assert {threads for _, threads, _ in seen} == {1}
    expected = os.environ.get("MALLOC_TRIM_THRESHOLD_", "1000000000")
    assert {value for _, _, value in seen} == {expected}


@pytest.mark.parametrize(("tasks", "workers"), [([PROBE] * 3, 1), ([PROBE], 4), ([PROBE], None)])
def test_one_worker_or_one_task_stays_in_this_process(
    tasks: list[str], workers: int | None
) -> None:
    assert [pid for pid, _, _ in map_in_processes(eval, tasks, workers)] == [os.getpid()] * len(
        tasks
    )


@pytest.mark.parametrize("workers", [None, 1, 2])
def test_no_task(workers: int | None) -> None:
    assert list(map_in_processes(math.sqrt, [], workers)) == []


@pytest.mark.parametrize("workers", [0, -3])
def test_too_few_workers(workers: int) -> None:
    with pytest.raises(OptionError, match=f"workers must be at least 1, not {workers}"):
        list(map_in_processes(math.sqrt, [1.0], workers))


@pytest.mark.parametrize(
    ("function", "tasks", "workers", "error"),
    [
        (math.sqrt, [1.0, -1.0, 4.0], 1, ValueError),
        (load_image, ["none.png", "nothing.png", "nil.png"], 2, ImageError),
    ],
)
def test_errors_reach_the_caller(
    function: Callable, tasks: list, workers: int, error: type[Exception], tmp_path: Path
) -> None:
    if function is load_image:
        tasks = [tmp_path / name for name in tasks]
    with pytest.raises(error) as caught:
        list(map_in_processes(function, tasks, workers))
    if error is ImageError:
        assert "there is no file" in str(caught.value)
        assert str(tmp_path) in str(caught.value)


def test_processor_count() -> None:
    assert 1 <= processor_count() <= (os.cpu_count() or 1)
