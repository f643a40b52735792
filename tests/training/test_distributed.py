"""Several processes train as one does."""

from __future__ import annotations

import csv
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

pytestmark = pytest.mark.slow  # torchrun starts two interpreters with torch in each test

# Eight steps; at higher rates Adam makes much of the rounding in tiny gradients.
ARGUMENTS = [
    *("--stage", "64x4x3", "--short-side", "64", "--detectors", "fast,sobel", "--val-count"),
    *("8", "--precision", "float32", "--no-compile", "--threads", "1", "--workers", "1"),
    *("--learning-rate", "0.0003"),
]


def launcher(processes: int) -> list[str]:
    if processes == 1:
        return [sys.executable]
    torchrun = ["torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    return [sys.executable, "-m", *torchrun]


def command(processes: int, photographs: Path, output: Path, labels: Path) -> list[str]:
    """The command of a tiny run in several processes (gloo)."""
    arguments = ["-m", "deepdetect", "train", str(photographs), "-o", str(output)]
    arguments += ["--labels", str(labels), "--device", "cpu", *ARGUMENTS]
    return [*launcher(processes), *arguments]


def run(processes: int, photographs: Path, output: Path, labels: Path) -> str:
    """Train and return what is printed."""
    whole = command(processes, photographs, output, labels)
    done = subprocess.run(whole, capture_output=True, text=True, timeout=300)
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


def test_only_the_main_process_prints(two_processes: tuple[Path, str]) -> None:
    output = two_processes[1]
    assert output.count("best after epoch") == 1
    assert "2 processes" in output


GRADIENTS = """
import os
import sys
import numpy as np
import torch
from safetensors.torch import save_file
from torch.nn.functional import binary_cross_entropy_with_logits
from deepdetect.detector.network.espnet import ESPNet
from deepdetect.training.engine import Engine, freeze_batch_norm
from deepdetect.training.recipe import DeviceOptions

torch.manual_seed(0)
network = ESPNet()
engine = Engine(network, DeviceOptions("cpu", "float32", compile=False, threads=1))
generator = np.random.default_rng(0)
rgb = torch.from_numpy(generator.integers(0, 256, (4, 64, 64, 3), np.uint8))
masks = torch.from_numpy(generator.random((4, 1, 64, 64)) > 0.5).float()
mine = engine.context.local_slice(4)
network.train()
if sys.argv[2] == "frozen":
    freeze_batch_norm(network)
loss = binary_cross_entropy_with_logits(engine.logits(engine.to_float(rgb[mine])), masks[mine])
engine.fabric.backward(loss)
if engine.context.is_main:
    tensors = {f"gradient.{n}": p.grad.contiguous() for n, p in network.named_parameters()}
    tensors |= {n: b.float().contiguous() for n, b in network.named_buffers()}
    save_file(tensors, sys.argv[1])
engine.close()
os._exit(0)  # Python's own end can meet gloo's threads
"""


@pytest.mark.parametrize("norm", ["batch", "frozen"])
def test_gradients_and_statistics_are_those_of_one_process(norm: str, tmp_path: Path) -> None:
    """Adam would hide gradients that are too large by a factor."""
    from safetensors.torch import load_file

    script = tmp_path / "gradients.py"
    script.write_text(GRADIENTS)
    results = []
    for processes in (1, 2):
        path = tmp_path / f"{processes}.safetensors"
        subprocess.run(
            [*launcher(processes), str(script), str(path), norm], check=True, capture_output=True
        )
        results.append(load_file(path))
    alone, together = results
    assert alone.keys() == together.keys()
    largest = max(float(alone[name].norm()) for name in alone if name.startswith("gradient."))
    for name, expected in alone.items():
        tolerance = 1e-4 * (largest if name.startswith("gradient.") else 1)
        torch.testing.assert_close(together[name], expected, atol=tolerance, rtol=1e-4)


@pytest.mark.skipif(sys.platform != "linux", reason="finds the processes in /proc")
def test_a_killed_run_of_two_processes_resumes_with_the_same_losses(
    photographs: Path, two_processes: tuple[Path, str], tmp_path: Path
) -> None:
    unbroken = two_processes[0]
    whole = command(2, photographs, tmp_path / "killed", unbroken.parent / "labels")
    process = subprocess.Popen(
        whole, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    checkpoint = tmp_path / "killed" / "checkpoint.safetensors"
    deadline = time.monotonic() + 120
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    workers = children(process.pid)  # torchrun gives each a session of its own
    os.killpg(process.pid, signal.SIGKILL)
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    process.wait()
    assert len(workers) == 2
    assert not (tmp_path / "killed" / "deepdetect.onnx").exists(), "it was killed before its end"
    subprocess.run(whole, check=True, capture_output=True, timeout=300)
    for expected, found in zip(curves(unbroken), curves(tmp_path / "killed"), strict=True):
        assert found["training_loss"] == pytest.approx(expected["training_loss"], abs=1e-5)
        assert found["validation_loss"] == pytest.approx(expected["validation_loss"], abs=1e-5)


def children(parent: int) -> list[int]:
    """Return the processes that a process has started."""
    found = []
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":\t", 1) for line in status.read_text().splitlines())
        except (OSError, ValueError):
            continue  # it has ended meanwhile
        if int(fields["PPid"]) == parent:
            found.append(int(fields["Pid"]))
    return found


def test_an_uneven_batch_is_reported_before_any_work(photographs: Path, tmp_path: Path) -> None:
    whole = [*command(2, photographs, tmp_path / "run", tmp_path / "labels"), "--stage", "64x3x1"]
    done = subprocess.run(whole, capture_output=True, text=True, timeout=300)
    assert done.returncode != 0
    assert "a batch of 3 cannot be divided evenly among 2 processes" in done.stderr
    assert "OptionError" not in done.stderr
    assert not (tmp_path / "labels").exists()


def test_processes_without_the_same_photographs_all_stop(photographs: Path, tmp_path: Path) -> None:
    """As on two machines, one of which lacks a photograph."""
    script = tmp_path / "machine.py"
    for k in range(2):
        shutil.copytree(photographs, tmp_path / f"photos{k}")
    (tmp_path / "photos1" / "photo03.png").unlink()
    arguments = ["train", "PHOTOS", "-o", str(tmp_path / "run"), "--device", "cpu", *ARGUMENTS]
    script.write_text(
        "import os, sys\n"
        "from deepdetect.cli import main\n"
        f"arguments = {arguments!r}\n"
        f"arguments[1] = {str(tmp_path / 'photos')!r} + os.environ['RANK']\n"
        "main(arguments)\n"
    )
    done = subprocess.run([*launcher(2), str(script)], capture_output=True, text=True, timeout=300)
    assert done.returncode != 0
    assert "every machine needs the same files" in done.stderr
    assert not (tmp_path / "run" / "checkpoint.safetensors").exists()


def test_an_unexpected_error_ends_all_processes(photographs: Path, tmp_path: Path) -> None:
    """Out of memory, say, in one process while the other waits for it."""
    script = tmp_path / "broken.py"
    arguments = ["train", str(photographs), "-o", str(tmp_path / "run"), "--device", "cpu"]
    script.write_text(
        "import os\n"
        "from deepdetect.cli import main\n"
        "from deepdetect.training.learner import Learner\n"
        "def learn(*arguments):\n"
        "    raise MemoryError('no more')\n"
        "if os.environ['RANK'] == '1':\n"
        "    Learner.training_step = learn\n"
        f"main({[*arguments, *ARGUMENTS]!r})\n"
    )
    done = subprocess.run([*launcher(2), str(script)], capture_output=True, text=True, timeout=300)
    assert done.returncode != 0
    assert "MemoryError: no more" in done.stderr
