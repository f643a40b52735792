from __future__ import annotations

import csv
import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from deepdetect import DeepDetect, OptionError, WeightsError
from deepdetect_lab.labels import LabelOptions
from deepdetect_lab.networks.espnet import ESPNet
from deepdetect_lab.networks.weights import (
    average_weights,
    find_weights,
    load_network,
    read_notes,
    save_tensors,
    weights_digest,
)
from deepdetect_lab.training import trainer as trainer_module
from deepdetect_lab.training.checkpoint import read_checkpoint
from deepdetect_lab.training.dense import DenseTrainer, initial_network
from deepdetect_lab.training.recipe import DeviceOptions, Stage, TrainingOptions
from deepdetect_lab.training.run import train
from deepdetect_lab.training.trainer import TrainingResult

from .conftest import plain_options

PLAIN = DeviceOptions("cpu", "float32", compile=False, threads=1)
OPTIONS = plain_options(
    stages=(Stage(32, 4, 3), Stage(64, 2, 1)),
    short_sides=(64, 48),
    labels=LabelOptions(("fast", "sobel")),
    val_count=3,
)

TINY = dataclasses.replace(OPTIONS, stages=(Stage(64, 4, 1),), short_sides=(64,), val_count=1)
STEPS = 11 * 3 // 4 + 11 // 2  # of OPTIONS; one of the twelve images is held out


@pytest.fixture
def every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a checkpoint after each step."""
    monkeypatch.setattr(trainer_module, "CHECKPOINT_INTERVAL_S", 0)


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("labels")


@pytest.fixture(scope="module")
def run(photographs: Path, labels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run."""
    folder = tmp_path_factory.mktemp("run")
    train(photographs, folder, OPTIONS, labels=labels, device=PLAIN, workers=1)
    return folder


@pytest.fixture
def fit(photographs: Path, labels: Path) -> Any:
    """Train in this process, with the labels that there are."""

    def call(folder: Path, options: TrainingOptions = OPTIONS, **named: Any) -> TrainingResult:
        images = named.pop("images", photographs)
        values = {"labels": labels, "device": PLAIN, "workers": 1, **named}
        return train(images, folder, options, **values)

    return call


def tensors_equal(a: Path, b: Path) -> bool:
    first, second = load_file(a), load_file(b)
    return first.keys() == second.keys() and all(
        torch.equal(first[name], second[name]) for name in first
    )


def same_run(a: Path, b: Path) -> bool:
    return (
        all(
            tensors_equal(a / name, b / name)
            for name in ("best.safetensors", "checkpoint.safetensors")
        )
        and (a / "curves.csv").read_text() == (b / "curves.csv").read_text()
    )


def interrupted(monkeypatch: pytest.MonkeyPatch, method: str, count: int) -> Any:
    """Let a method of the trainer fail when it is called again after this many calls."""
    calls = iter(range(count))
    whole = getattr(DenseTrainer, method)

    def step(*arguments: object) -> object:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return whole(*arguments)

    monkeypatch.setattr(DenseTrainer, method, step)
    return pytest.raises(KeyboardInterrupt)


def test_a_run_writes_weights_and_curves(run: Path) -> None:
    assert {path.name for path in run.iterdir()} >= {
        "best.safetensors",
        "checkpoint.safetensors",
        "curves.csv",
        "deepdetect.onnx",
        "MODEL_CARD.md",
    }
    rows = list(csv.DictReader((run / "curves.csv").read_text().splitlines()))
    assert [int(row["step"]) for row in rows] == [round(STEPS * k / 3) for k in (1, 2, 3)]
    assert len({row["training_loss"] for row in rows}) == 3
    image = np.random.default_rng(0).integers(0, 256, (40, 56, 3), np.uint8)
    with torch.inference_mode():
        planes = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
        torch_map = load_network(run / "best.safetensors")(planes)[0, 0].sigmoid()
    onnx_map = DeepDetect(run / "deepdetect.onnx", backend="onnxruntime").heatmap(image)
    np.testing.assert_allclose(torch_map, onnx_map, atol=1e-4)


def test_the_best_weights_say_where_they_come_from(run: Path) -> None:
    notes = read_notes(run / "best.safetensors")
    point = json.loads(notes["point"])
    rows = list(csv.DictReader((run / "curves.csv").read_text().splitlines()))
    lowest = min(float(row["validation_loss"]) for row in rows)
    assert point["validation_loss"] == pytest.approx(lowest, rel=1e-5)
    assert "torch 2." in notes["versions"]
    assert len(notes["images_digest"]) == 16
    assert json.loads(notes["options"])["seed"] == 0
    metadata = read_checkpoint(run / "checkpoint.safetensors")[1]
    assert {"command", "commit", "versions", "machine", "images"} <= metadata.keys()
    card = (run / "MODEL_CARD.md").read_text()
    for name in ("command", "commit", "versions", "images_digest", "initial_weights"):
        assert notes[name] in card


@pytest.mark.slow
@pytest.mark.usefixtures("every_step")
@pytest.mark.parametrize(("method", "count"), [("training_step", 6), ("heatmap", 3)])
def test_an_interrupted_run_ends_with_the_same_weights(
    method: str, count: int, run: Path, tmp_path: Path, fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, interrupted(patch, method, count):
        fit(tmp_path)
    step = read_checkpoint(tmp_path / "checkpoint.safetensors")[1]["step"]
    assert 0 < step < STEPS
    fit(tmp_path)
    assert same_run(tmp_path, run)


@pytest.mark.slow
@pytest.mark.usefixtures("every_step")
def test_the_default_recipe_resumes_with_the_same_weights(
    tmp_path: Path, fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = "stages", "short_sides", "labels", "val_count"
    values = {name: getattr(OPTIONS, name) for name in names}
    options = TrainingOptions(augmentations=1, **values)
    fit(tmp_path / "whole", options)
    with monkeypatch.context() as patch, interrupted(patch, "training_step", 7):
        fit(tmp_path / "run", options)
    fit(tmp_path / "run", options)
    assert same_run(tmp_path / "run", tmp_path / "whole")


def test_starting_again_after_the_end_changes_nothing(run: Path, tmp_path: Path, fit) -> None:
    shutil.copytree(run, tmp_path / "run")
    before = (run / "checkpoint.safetensors").read_bytes()
    result = fit(tmp_path / "run")
    assert len(result.points) == 3
    assert (tmp_path / "run" / "checkpoint.safetensors").read_bytes() == before


def test_another_run_in_the_same_folder_is_refused(
    run: Path, photographs: Path, tmp_path: Path, fit
) -> None:
    for name, changes in (
        ("`seed`", {"options": dataclasses.replace(OPTIONS, seed=5)}),
        ("`images_digest`", {"validation": photographs}),
        ("`initial_weights`", {"init_weights": "espnet"}),
    ):
        with pytest.raises(OptionError, match=name):
            fit(run, **changes)


def test_missing_best_weights_are_told(run: Path, tmp_path: Path, fit) -> None:
    shutil.copy(run / "checkpoint.safetensors", tmp_path)
    with pytest.raises(WeightsError, match=r"best\.safetensors"):
        fit(tmp_path)


@pytest.mark.slow
def test_trained_weights_keep_their_batch_statistics_and_learn(
    tmp_path: Path, fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = find_weights("espnet")
    fit(tmp_path / "moved", TINY, init_weights="espnet")
    before, after = load_file(start), load_file(tmp_path / "moved" / "best.safetensors")
    kept = {name for name in before if torch.equal(before[name], after[name])}
    statistics = {name for name in before if name.rpartition(".")[2].startswith(("running", "num"))}
    assert kept == statistics
    assert read_notes(tmp_path / "moved" / "best.safetensors")["initial_weights"] == weights_digest(
        load_network(start)
    )
    still = dataclasses.replace(TINY, learning_rate=1e-300, frozen_batch_norm=False)
    monkeypatch.setattr("deepdetect_lab.training.sampler.FINAL_LEARNING_RATE", 0)
    fit(tmp_path / "still", still, init_weights=start)
    after = load_file(tmp_path / "still" / "best.safetensors")
    assert all(torch.equal(before[name], after[name]) for name, _ in ESPNet().named_parameters())
    assert not any(torch.equal(before[name], after[name]) for name in statistics)


@pytest.mark.slow
def test_a_run_can_start_from_the_mean_of_several_weights(run: Path, tmp_path: Path, fit) -> None:
    first, other = run / "best.safetensors", tmp_path / "other.safetensors"
    changed = load_network(first)
    with torch.no_grad():
        changed.classifier.weight += 2
    save_tensors(changed.state_dict(), other, {})
    mean = average_weights([first, other])
    for name, value in load_network(first).state_dict().items():
        expected = value + 1 if name == "classifier.weight" else value
        torch.testing.assert_close(mean.state_dict()[name], expected)
    fit(tmp_path / "run", TINY, init_weights=[first, other])
    notes = read_notes(tmp_path / "run" / "best.safetensors")
    assert notes["initial_weights"] == weights_digest(mean)


def test_random_weights_are_not_kept(photographs: Path, tmp_path: Path) -> None:
    options = dataclasses.replace(TINY, frozen_batch_norm=True)
    with pytest.raises(OptionError, match=r"`frozen_batch_norm`.*`init_weights`"):
        train(photographs, tmp_path / "run", options, device=PLAIN)
    assert not (tmp_path / "run").exists()


def test_the_caller_keeps_its_random_numbers() -> None:
    """Random weights are those of the seed, as `torch.manual_seed` would make them."""
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    network = initial_network(TrainingOptions(network="espnet", seed=5), None)[1]
    assert torch.equal(torch.rand(4), expected)
    torch.manual_seed(5)
    for one, other in zip(network.parameters(), ESPNet().parameters(), strict=True):
        assert torch.equal(one, other)


def command(photographs: Path, run: Path, labels: Path, *more: str) -> list[str]:
    """A run in a process of its own, which can be killed."""
    return [
        *(sys.executable, "-m", "deepdetect", "train", str(photographs), "-o", str(run)),
        *("--labels", str(labels), "--val-count", "8", "--detectors", "fast,sobel"),
        *("--precision", "float32", "--no-compile", "--threads", "1", "--workers", "1", "--json"),
        *("--stage", "64x4x8", "--stage", "96x2x2", "--short-side", "96", "--short-side", "64"),
        *more,
    ]


@pytest.mark.slow
@pytest.mark.parametrize("more", [[], ["--optimizer", "soap", "--num-workers", "1"]])
def test_a_killed_run_ends_with_the_same_weights(
    more: list[str], photographs: Path, labels: Path, tmp_path: Path
) -> None:
    subprocess.run(
        command(photographs, tmp_path / "whole", labels, *more), check=True, capture_output=True
    )
    arguments = command(photographs, tmp_path / "killed", labels, *more)
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 120
    checkpoint = tmp_path / "killed" / "checkpoint.safetensors"
    while not checkpoint.exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL, "the run must be killed before its end"
    last = read_checkpoint(tmp_path / "whole" / "checkpoint.safetensors")[1]["step"]
    assert 0 < read_checkpoint(checkpoint)[1]["step"] < last
    subprocess.run(arguments, check=True, capture_output=True)
    assert same_run(tmp_path / "killed", tmp_path / "whole")


@pytest.mark.slow
def test_own_images_and_settings_from_the_pretrained_weights(
    photographs: Path, tmp_path: Path
) -> None:
    """The command of docs/training.md, on few images."""
    settings = tmp_path / "labels.toml"
    settings.write_text('detectors = ["fast", "sobel"]\n[fast]\nnormal = { threshold = 30 }\n')
    arguments = [sys.executable, "-m", "deepdetect", "train", str(photographs)]
    arguments += ["-o", str(tmp_path / "run"), "--label-settings", str(settings)]
    arguments += ["--preset", "espnet", "--init", "espnet"]
    arguments += ["--stage", "96x4x12", "--short-side", "96", "--learning-rate", "0.0005"]
    arguments += ["--warm-up", "0.05", "--dark-fraction", "0", "--val-count", "3", "--no-compile"]
    subprocess.run(
        [*arguments, "--workers", "1", "--threads", "1", "--json"], check=True, capture_output=True
    )
    rows = list(csv.DictReader((tmp_path / "run" / "curves.csv").read_text().splitlines()))
    losses = [float(row["normal_loss"]) for row in rows]
    assert losses[-1] < losses[0], "it learns the new labels"
    image = photographs / "photo00.png"
    tuned = DeepDetect(tmp_path / "run" / "deepdetect.onnx").detect(image)
    assert 0 < len(tuned) < len(DeepDetect().detect(image)), "fewer corners are wanted"
