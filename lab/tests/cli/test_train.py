"""`deepdetect train`: options, output, and errors in terms of flags."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.command_line import run_command

from deepdetect_lab.training import PRESETS
from deepdetect_lab.training.dense import DenseTrainer

TINY = [
    *("--stage", "64x4x1", "--short-side", "64", "--detectors", "fast", "--val-count", "1"),
    *("--device", "cpu", "--precision", "float32", "--no-compile", "--threads", "1"),
]


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of six small photographs."""
    from PIL import Image
    from skimage import data

    folder = tmp_path_factory.mktemp("images")
    for k in range(6):
        Image.fromarray(data.chelsea()[20 * k : 20 * k + 96, 60:180]).save(folder / f"{k}.png")
    return folder


def test_train(run, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = run("train", images, "-o", "run", *TINY, "--workers", "1", "--json")
    assert trained.exit_code == 0, trained.output
    values = json.loads(trained.stdout)
    assert Path(values["onnx"]).is_file()
    assert values["validation_loss"] > 0
    monkeypatch.setattr(DenseTrainer, "export", lambda *_: None)  # it is there
    again = run("train", images, "-o", "run", *TINY, "--workers", "1")
    assert "validation loss" in again.output
    other = run("train", images, "-o", "run", *TINY, "--short-side", "96")
    assert other.exit_code == 2
    assert "--short-side" in other.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("--frozen-batch-norm", "--frozen-batch-norm"),
        ("--num-workers -1", "--num-workers"),
        ("--stage 480x8x1@720", "--short-side"),
        ("--optimizer sopa", "soap"),
    ],
)
def test_errors_speak_of_flags(run, images: Path, arguments: str, named: str) -> None:
    result = run("train", images, "-o", "out", *arguments.split())
    assert result.exit_code == 2
    assert named in result.stderr
    assert not Path("out").exists()


def test_a_preset_is_changed_by_options(
    images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from deepdetect_lab.training import dense

    seen: list[tuple] = []

    def initial_network(*arguments: object) -> None:
        seen.append(arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(dense, "initial_network", initial_network)
    words = ["train", str(images), "-o", str(tmp_path), "--preset", "paper", "--stage", "480x64x9"]
    words += ["--no-interleave", "--transpositions", "--batch-norm"]
    words += ["--init", "default", "--init", "dense"]
    assert run_command(words).exit_code == 130
    ((options, init_weights),) = seen
    assert [stage.epochs for stage in options.stages] == [9]
    assert options.transpositions
    assert options.frozen_batch_norm is False
    assert options.max_images == PRESETS["paper"].max_images
    assert init_weights == ("default", "dense")


def test_train_descriptor_writes_what_extract_takes(run, tmp_path: Path) -> None:
    from PIL import Image
    from skimage import data

    from deepdetect import PointDetector

    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(data.astronaut()).save(photos / "astronaut.png")
    tiny = ["--steps", "1", "--pairs", "2", "--val-count", "1", "--val-pairs", "1"]
    where = ["--validation", photos, "--device", "cpu", "-o", tmp_path / "run"]
    made = run("train-descriptor", photos, *where, *tiny, "--json")
    assert made.exit_code == 0, made.output
    values = json.loads(made.stdout)
    assert values["best"]["step"] == 1
    found = PointDetector(50, descriptor=values["onnx"]).extract(data.astronaut())
    assert found.descriptors is not None
    assert found.descriptors.shape == (50, 64)
