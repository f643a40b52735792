from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from deepdetect import ImageError, MissingExtraError, PointDetector, load_image
from deepdetect.batch import extract_features
from deepdetect.batch.engines import map_on_ray


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError):
        list(map_on_ray(math.sqrt, [1.0]))


@pytest.fixture
def _ray() -> None:
    pytest.importorskip("ray", reason="needs Ray (the extra ray)")
    pytest.importorskip("h5py", reason="needs h5py")


@pytest.mark.slow
@pytest.mark.usefixtures("_ray")
@pytest.mark.filterwarnings("ignore")
def test_outcomes_and_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "local")
    assert list(map_on_ray(math.factorial, [])) == []
    tasks = list(range(50))
    assert sorted(map_on_ray(math.factorial, tasks, 2)) == [math.factorial(n) for n in tasks]
    with pytest.raises(ImageError):
        list(map_on_ray(load_image, ["none.png"], 1))


def start(folder: Path, output: Path, address: str = "local") -> subprocess.Popen[str]:
    """Start an extraction on Ray."""
    command = [sys.executable, "-m", "deepdetect", "extract", str(folder), "-o", str(output)]
    command += ["--max-keypoints", "500", "--engine", "ray", "--workers", "2", "--json"]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "RAY_ADDRESS": address},
    )


def wait_for_shards(output: Path, count: int, process: subprocess.Popen[str]) -> None:
    """Wait until so many shards of an extraction are written."""
    folder = output.with_name(output.name + ".shards")
    deadline = time.monotonic() + 600
    while len(list(folder.glob("*/[0-9a-f]*.h5"))) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def processes() -> Iterator[tuple[int, int, str]]:
    """Yield number, parent's number and command line of each process."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            yield (
                int(folder.name),
                parent,
                (folder / "cmdline").read_bytes().decode(errors="replace"),
            )
        except OSError:
            continue


def descendants(ancestor: int, word: str) -> list[int]:
    """Return the processes below one whose command line has a word."""
    found = {number: (parent, command) for number, parent, command in processes()}

    def is_below(number: int) -> bool:
        while number in found:
            number = found[number][0]
            if number == ancestor:
                return True
        return False

    return [n for n, (_, command) in found.items() if word in command and is_below(n)]


def check(
    process: subprocess.Popen[str],
    folder: Path,
    output: Path,
    same_content: Callable[..., bool],
    skipped: int = 0,
) -> None:
    """Check that nothing is lost, nothing double, and all as without a cluster."""
    told, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    report = json.loads(told)
    names = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*.png"))]
    assert len(report["images"]) + report["skipped"] == len(names)
    assert report["skipped"] == skipped
    assert len(set(report["images"])) == len(report["images"])
    assert set(report["images"]) <= set(names)
    whole = PointDetector(500)
    extract_features(folder, output.with_name("whole.h5"), whole, workers=2)
    assert same_content(output, output.with_name("whole.h5"))
    assert sorted(path.name for path in output.parent.glob("*.h5*")) == ["f.h5", "whole.h5"]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc to find the worker")
@pytest.mark.usefixtures("_ray")
def test_a_worker_is_killed_half_way(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    folder, output = collection(60), tmp_path / "f.h5"
    process = start(folder, output)
    try:
        wait_for_shards(output, 30, process)
        workers = descendants(process.pid, "ray::MapWorker")
        assert len(workers) == 2
        os.kill(workers[0], signal.SIGKILL)
        check(process, folder, output, same_content)
    finally:
        process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("_ray")
def test_the_driver_is_killed_half_way(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    folder, output = collection(60), tmp_path / "f.h5"
    process = start(folder, output)
    wait_for_shards(output, 30, process)
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 60
    while any(str(tmp_path) in command for _, _, command in processes()):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    time.sleep(5)  # for the workers, which have other command lines
    kept = len(list(output.with_name("f.h5.shards").glob("*/[0-9a-f]*.h5")))
    assert kept >= 30
    process = start(folder, output)
    try:
        check(process, folder, output, same_content, kept)
    finally:
        process.kill()


@pytest.mark.slow
@pytest.mark.usefixtures("_ray")
@pytest.mark.filterwarnings("ignore")
def test_a_machine_of_a_cluster_is_lost_half_way(
    collection: Callable[..., Path], tmp_path: Path, same_content: Callable[..., bool]
) -> None:
    """Two machines of one processor each, here two raylets; the second one is killed."""
    from ray.cluster_utils import Cluster

    folder, output = collection(60), tmp_path / "f.h5"
    memory = 100_000_000
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": memory}
    )
    try:
        second = cluster.add_node(num_cpus=1, object_store_memory=memory)
        process = start(folder, output, cluster.address)
        try:
            wait_for_shards(output, 30, process)
            cluster.remove_node(second, allow_graceful=False)
            check(process, folder, output, same_content)
        finally:
            process.kill()
    finally:
        cluster.shutdown()
