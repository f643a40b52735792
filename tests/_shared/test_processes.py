from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from deepdetect._shared.errors import DeepDetectError, ImageError, OptionError
from deepdetect._shared.processes import map_in_processes, processor_count
from deepdetect.io.image import load_image

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


def test_a_dead_worker_is_one_sentence() -> None:
    with pytest.raises(DeepDetectError, match="fewer --workers"):
        list(map_in_processes(os._exit, [9, 9, 9], 2))


def test_workers_end_when_the_parent_is_killed(tmp_path: Path) -> None:
    """Nobody should have to look for left-over processes."""
    (tmp_path / "endless.py").write_text(
        "import time\n"
        "from pathlib import Path\n"
        "from deepdetect._shared.processes import map_in_processes\n"
        "def work(task):\n"
        "    import os\n"
        "    Path(f'pid{task}').write_text(str(os.getpid()))\n"
        "    time.sleep(600)\n"
        "if __name__ == '__main__':\n"
        "    list(map_in_processes(work, [0, 1], 2))\n"
    )
    process = subprocess.Popen([sys.executable, "endless.py"], cwd=tmp_path)
    pids = [tmp_path / "pid0", tmp_path / "pid1"]
    _wait_until(lambda: all(path.exists() and path.read_text() for path in pids))
    process.kill()
    process.wait()
    _wait_until(lambda: not any(_runs(int(path.read_text())) for path in pids))


def _runs(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    if not Path("/proc").is_dir():
        pytest.skip("needs /proc to see whether a process runs")
    # A killed process may stay as a zombie until it is collected.
    return status.exists() and status.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline, "it did not happen within a minute"
        time.sleep(0.05)
