"""Several processes train as one does."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from hypothesis import given  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from deepdetect import OptionError  # noqa: E402
from deepdetect.training.cluster import Place, place_in_cluster  # noqa: E402

# Eight steps; at higher rates Adam makes much of the rounding in tiny gradients.
ARGUMENTS = [
    *("--stage", "64x4x3", "--short-side", "64", "--detectors", "fast,sobel", "--validations"),
    *("8", "--precision", "float32", "--no-compile", "--threads", "1", "--workers", "1"),
    *("--learning-rate", "0.0003"),
]


def run(processes: int, photographs: Path, output: Path, labels: Path, *more: str) -> str:
    """Train in so many processes (gloo) and return what is printed."""
    launcher = [sys.executable]
    if processes > 1:
        launcher += ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    command = [*launcher, "-m", "deepdetect", "train", str(photographs), "-o", str(output)]
    command += ["--labels", str(labels), "--device", "cpu", *ARGUMENTS, *more]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def curves(run_folder: Path) -> list[dict[str, float]]:
    rows = csv.DictReader((run_folder / "curves.csv").read_text().splitlines())
    return [{name: float(value) for name, value in row.items()} for row in rows]


@pytest.fixture(scope="module")
def one_process(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cluster")
    run(1, photographs, folder / "one", folder / "labels")
    return folder / "one"


@pytest.fixture(scope="module")
def two_processes(photographs: Path, one_process: Path) -> tuple[Path, str]:
    folder = one_process.parent
    return folder / "two", run(2, photographs, folder / "two", folder / "labels")


def test_two_processes_have_the_losses_of_one(
    one_process: Path, two_processes: tuple[Path, str]
) -> None:
    alone, together = curves(one_process), curves(two_processes[0])
    assert len(alone) == len(together) == 8
    for expected, found in zip(alone, together, strict=True):
        assert found["images"] == expected["images"]
        assert found["training_loss"] == pytest.approx(expected["training_loss"], abs=1e-4)
        assert found["validation_loss"] == pytest.approx(expected["validation_loss"], abs=1e-4)
    losses = [row["training_loss"] for row in alone]
    assert max(losses) - min(losses) > 100 * 1e-4, "batches differ by much more than processes"


def test_only_the_first_process_speaks(two_processes: tuple[Path, str]) -> None:
    output = two_processes[1]
    assert output.count("best after epoch") == 1
    assert "2 processes" in output


def test_a_run_of_two_processes_goes_on_in_two(
    photographs: Path, two_processes: tuple[Path, str]
) -> None:
    folder = two_processes[0]
    before = (folder / "checkpoint.safetensors").read_bytes()
    run(2, photographs, folder, folder.parent / "labels")
    assert (folder / "checkpoint.safetensors").read_bytes() == before


def test_an_uneven_share_is_refused(photographs: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "deepdetect", "train", str(photographs), "-o"]
    command += [str(tmp_path / "run"), *ARGUMENTS, "--stage", "64x3x1", "--device", "cpu"]
    environment = {
        **os.environ,
        "TORCHELASTIC_RUN_ID": "test",
        "RANK": "0",
        "WORLD_SIZE": "1",
        "LOCAL_RANK": "0",
        "LOCAL_WORLD_SIZE": "1",
    }
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, "one process takes any batch"
    with pytest.raises(OptionError, match="multiple"):
        Place(1, 2, 1, 2).share(3)


@given(processes=st.integers(1, 9), part=st.integers(1, 9))
def test_shares_cover_everything_once(processes: int, part: int) -> None:
    count = processes * part
    seen = [
        k
        for rank in range(processes)
        for k in range(count)[Place(rank, processes, rank, processes).share(count)]
    ]
    assert seen == list(range(count))


def test_the_place_is_read_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    monkeypatch.setenv("RANK", "3")
    assert place_in_cluster() == Place(), "a variable of another program is no cluster"
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    monkeypatch.setenv("WORLD_SIZE", "8")
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    place = place_in_cluster()
    assert place == Place(3, 8, 1, 2)
    assert place.machines == 4
    assert not place.is_first
