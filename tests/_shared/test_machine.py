from __future__ import annotations

import math
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from deepdetect._shared import machine
from deepdetect._shared.errors import DeepDetectError, ImageError, OptionError
from deepdetect._shared.machine import (
    available_memory,
    limited_threads,
    map_in_processes,
    parallel_for,
    require_memory,
)
from deepdetect.io.image import load_image

# The workers import functions by name, so these tests send functions of installed modules.
PROBE = "(__import__('os').getpid(), __import__('cv2').getNumThreads())"


def test_outcomes_equal_serial_ones() -> None:
    tasks = list(range(25))  # more than the workers are given at first
    outcomes = map_in_processes(math.factorial, tasks, workers=2)
    assert list(outcomes) == [math.factorial(task) for task in tasks]


def test_workers_are_other_processes_with_one_thread() -> None:
    found = list(map_in_processes(eval, [PROBE] * 6, workers=2))
    assert len(found) == 6
    assert os.getpid() not in {pid for pid, _ in found}
    assert {threads for _, threads in found} == {1}


@pytest.mark.parametrize(("tasks", "workers"), [([PROBE] * 3, 1), ([PROBE], 4), ([PROBE], None)])
def test_one_worker_or_one_task_stays_in_this_process(
    tasks: list[str], workers: int | None
) -> None:
    assert [pid for pid, _ in map_in_processes(eval, tasks, workers)] == [os.getpid()] * len(tasks)


def test_errors_reach_the_caller(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="math domain"):
        list(map_in_processes(math.sqrt, [1.0, -1.0, 4.0], 1))
    with pytest.raises(ImageError):
        list(map_in_processes(load_image, [tmp_path / f"{k}.png" for k in range(3)], 2))


def test_a_dead_worker_is_one_sentence() -> None:
    with pytest.raises(DeepDetectError, match="`workers`"):
        list(map_in_processes(os._exit, [9, 9, 9], 2))


ENDLESS = """
import os, sys, time
from pathlib import Path
from deepdetect._shared import machine

def work(task):
    Path(f"pid{task}").write_text(str(os.getpid()))
    time.sleep(SECONDS)

if __name__ == "__main__":
    try:
        list(machine.map_in_processes(work, range(100), 2))
    except KeyboardInterrupt:
        sys.exit(130)
"""
SLOW_OPENCV = """
import os, time
from pathlib import Path
Path(f"import{os.getpid()}").touch()
time.sleep(1)
__version__ = "5.0.0"
setNumThreads = print
"""


def start_endless_work(folder: Path, seconds: float = 600) -> subprocess.Popen[str]:
    (folder / "endless.py").write_text(ENDLESS.replace("SECONDS", f"{seconds}"))
    return subprocess.Popen(
        [sys.executable, "endless.py"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_workers_end_with_their_parent(number: int, tmp_path: Path) -> None:
    """Nobody should have to look for left-over processes."""
    process = start_endless_work(tmp_path)
    pids = [tmp_path / "pid0", tmp_path / "pid1"]
    _wait_until(lambda: all(path.exists() and path.read_text() for path in pids))
    process.send_signal(number)  # to it alone, as of process managers
    try:
        assert process.wait(timeout=60) != 0
    finally:
        process.kill()
        process.communicate()
    _wait_until(lambda: not any(_runs(int(path.read_text())) for path in pids))


@pytest.mark.skipif(os.name != "posix", reason="needs process groups")
@pytest.mark.parametrize("moment", ["while a worker starts", "while it works"])
def test_ctrl_c_ends_all_processes_without_a_word_of_theirs(moment: str, tmp_path: Path) -> None:
    starting = moment == "while a worker starts"
    if starting:  # the initializer imports it
        (tmp_path / "cv2.py").write_text(SLOW_OPENCV)
    process = start_endless_work(tmp_path, 0 if starting else 600)
    _wait_until(lambda: len(list(tmp_path.glob("import*" if starting else "pid*"))) == 2)
    os.killpg(process.pid, signal.SIGINT)
    try:
        _, told = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert told == ""
    assert len(list(tmp_path.glob("pid*"))) < 100


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


@given(count=st.integers(0, 200))
def test_each_number_is_done_once(count: int) -> None:
    done: list[int] = []
    parallel_for(count, lambda start, stop: done.extend(range(start, stop)))
    assert sorted(done) == list(range(count))


def test_several_threads_work_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(machine, "processor_count", lambda: 3)
    together = threading.Barrier(3, timeout=20)
    waited: list[int] = []

    def work(start: int, stop: int) -> None:
        if start < 3:  # the first three parts of one number each
            together.wait()
            waited.append(start)

    parallel_for(12, work)
    assert sorted(waited) == [0, 1, 2]


def test_an_error_in_a_part_is_the_callers() -> None:
    def work(start: int, stop: int) -> None:
        raise ZeroDivisionError("as it happens")

    with pytest.raises(ZeroDivisionError, match="as it happens"):
        parallel_for(5, work)


ARRAYS = """
import resource
import sys
from deepdetect._shared.machine import disable_malloc_trim

def make_and_free():
    for _ in range(20):
        blocks = [bytearray(3_000_000) for _ in range(10)]

if sys.argv[1] == "keep":
    disable_malloc_trim()
make_and_free()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
make_and_free()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(mode: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", ARRAYS, mode], check=True, capture_output=True, text=True
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_freed_memory_is_used_again_without_new_pages() -> None:
    assert page_faults("keep") < 0.1 * page_faults("give")


def test_there_is_memory_but_not_endlessly() -> None:
    assert 0 < available_memory() < 2**50


def test_memory_of_a_container_that_caches_files_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A control group may use 8 GB and uses 6 GB, of which 3 GB are files that can be dropped."""
    monkeypatch.setattr(machine, "Path", lambda _: tmp_path)
    monkeypatch.setattr(machine, "_system_memory", lambda: 2**45)
    without = available_memory()
    for name, text in (
        ("max", "8000000000\n"),
        ("current", "6000000000\n"),
        ("stat", "anon 2500000000\nfile 3500000000\ninactive_file 3000000000\nslab 5\n"),
    ):
        (tmp_path / f"memory.{name}").write_text(text)
    assert available_memory() == 5_000_000_000
    (tmp_path / "memory.current").write_text("12000000000\n")
    assert available_memory() == 0
    (tmp_path / "memory.max").write_text("max\n")
    assert available_memory() == without > 2**44


def test_a_step_that_does_not_fit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 1.5e9)
    require_memory("a million keypoints", "take fewer", matched_keypoint=1e6)
    with pytest.raises(OptionError):
        require_memory("many keypoints", "take fewer", matched_keypoint=1.1e6)


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_blas_uses_one_thread_in_calls_that_overlap() -> None:
    """Whichever of two threads ends last, the number of threads is then as before."""
    with threadpool_limits(2, user_api="blas"):
        entered, leave = threading.Event(), threading.Event()

        def call() -> None:
            with limited_threads():
                entered.set()
                leave.wait(10)

        other = threading.Thread(target=call)
        with limited_threads():
            other.start()
            entered.wait(10)
            assert blas_threads() == {1}
        leave.set()
        other.join()
        assert blas_threads() == {2}
