from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file

from deepdetect import OptionError, PointDetector, match_features
from deepdetect._shared.errors import WeightsError
from deepdetect._shared.records import file_digest
from deepdetect.io.image import find_images
from deepdetect_lab.networks.weights import load_network, read_notes
from deepdetect_lab.training import (
    DescriptorTrainingOptions,
    DeviceOptions,
    TrainingResult,
    train_on_pairs,
)
from deepdetect_lab.training.checkpoint import read_checkpoint
from deepdetect_lab.training.descriptor.losses import KINDS, shares_right
from deepdetect_lab.training.descriptor.network import DescriptorNetwork
from deepdetect_lab.training.descriptor.task import (
    DescriptorTrainer,
    draw_numbered,
    pairs_of_step,
    pairs_to_draw,
    validation_batches,
)
from deepdetect_lab.training.trainer import CHECKPOINT

OPTIONS = DescriptorTrainingOptions(steps=3, pairs=2, val_count=1, val_pairs=1)


def run(textures: Path, folder: Path, **how: Any) -> TrainingResult:
    return train_on_pairs(textures, textures, folder, OPTIONS, device="cpu", **how)


@pytest.fixture(scope="module", autouse=True)
def checkpoints_at_every_step() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deepdetect_lab.training.trainer.CHECKPOINT_INTERVAL_S", 0)
        yield


@pytest.fixture(scope="module")
def whole(textures: Path, tmp_path_factory) -> TrainingResult:
    return run(textures, tmp_path_factory.mktemp("whole"))


def test_training_changes_the_weights_and_measures(whole: TrainingResult) -> None:
    after = load_file(whole.weights.parent / CHECKPOINT)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        before = DescriptorNetwork()
    assert all((after[f"network.{n}"] != p).any() for n, p in before.named_parameters())
    assert [point["step"] for point in whole.points] == [3]
    shares = [whole.best[f"{kind} correct"] for kind in KINDS]
    assert whole.best["score"] == pytest.approx(np.mean(shares))
    assert (whole.weights.parent / "MODEL_CARD.md").is_file()


def test_an_interrupted_run_ends_with_the_same_weights(
    whole: TrainingResult, textures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, step = iter(range(2)), DescriptorTrainer.training_step

    def training_step(*arguments: Any) -> float:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return step(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(DescriptorTrainer, "training_step", training_step)
        with pytest.raises(KeyboardInterrupt):
            run(textures, tmp_path)
    assert read_checkpoint(tmp_path / CHECKPOINT)[1]["step"] == 2
    assert run(textures, tmp_path).points == whole.points
    first, second = (load_file(folder / CHECKPOINT) for folder in (tmp_path, whole.weights.parent))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_the_files_hold_the_weights_that_were_measured(
    whole: TrainingResult, textures: Path
) -> None:
    network: Any = load_network(whole.weights, DescriptorNetwork)
    shares = shares_right(network, validation_batches(find_images(textures), OPTIONS))
    assert np.mean(list(shares.values())) == pytest.approx(whole.best["score"], abs=1e-6)
    notes = read_notes(whole.weights)
    assert (notes["images"], notes["run_on"]) == ("4", "cpu")
    assert json.loads(notes["point"]) == whole.best


def test_the_onnx_file_describes_as_the_network(whole: TrainingResult) -> None:
    network: Any = load_network(whole.weights, DescriptorNetwork)
    rng = np.random.default_rng(2)
    luma = rng.random((1, 1, 256, 384), dtype=np.float32)
    xy = (rng.random((1, 70, 2)) * (384, 256) - 0.5).astype(np.float32)
    sizes = rng.uniform(2, 40, (1, 70)).astype(np.float32)
    session = onnxruntime.InferenceSession(whole.onnx, providers=["CPUExecutionProvider"])
    found = session.run(None, {"luma": luma, "xy": xy, "sizes": sizes})[0]
    with torch.no_grad():
        expected = network(*map(torch.from_numpy, (luma, xy, sizes))).numpy()
    np.testing.assert_allclose(found, expected, atol=5e-3)  # kernels are float16 there
    assert np.abs(expected[0] - expected[0, :1]).max() > 0.05


def test_own_weights_describe_points_and_are_of_their_own_type(
    whole: TrainingResult, textures: Path, tmp_path: Path
) -> None:
    image = textures / "0.png"
    assert whole.onnx is not None
    found = PointDetector(200, descriptor=whole.onnx).extract(image)
    assert found.descriptor_type == f"learned-{file_digest(whole.onnx)[:16]}"
    again = PointDetector(200, descriptor=str(whole.onnx)).extract(image)
    matches = match_features(found, again, ratio=1)
    np.testing.assert_array_equal(matches.points0, matches.points1)
    other = PointDetector(200).extract(image)
    with pytest.raises(OptionError):
        match_features(found, other)
    with pytest.raises(WeightsError, match="nowhere"):
        PointDetector(descriptor="nowhere/descriptor.onnx")
    (tmp_path / "broken.onnx").write_bytes(b"nothing")
    with pytest.raises(WeightsError, match="broken"):
        PointDetector(200, descriptor=tmp_path / "broken.onnx")


def test_a_run_starts_from_weights(whole: TrainingResult, textures: Path, tmp_path: Path) -> None:
    where = DeviceOptions(device="cpu")
    trainer = DescriptorTrainer(*[find_images(textures)] * 2, OPTIONS, whole.weights, where)
    weights = load_file(whole.weights)
    assert all(torch.equal(v, weights[k]) for k, v in trainer.network.state_dict().items())
    with pytest.raises(OptionError, match="initial_weights"):
        run(textures, whole.weights.parent, init_weights=whole.weights)
    with pytest.raises(WeightsError):
        run(textures, tmp_path, init_weights=tmp_path / "none.safetensors")


def test_pairs_are_drawn_once_and_seen_four_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("deepdetect_lab.training.descriptor.task.WINDOW", 400)
    options = DescriptorTrainingOptions(steps=3000, pairs=8)
    batches = [pairs_of_step(options, step) for step in range(3000)]
    times = Counter(number for batch in batches for number in batch.tolist())
    middle = range(1000, 1900)  # long after the start, and out of the window before the end
    assert np.mean([times[number] for number in middle]) == pytest.approx(4, abs=0.3)
    drawn = [number for _, numbers in pairs_to_draw(options, 0, 3000) for number in numbers]
    assert sorted(drawn) == sorted(times)
    resumed = dict(pairs_to_draw(options, 500, 502))
    assert set(resumed[500]) == set(batches[500].tolist())
    assert resumed[501] == sorted(set(batches[501].tolist()) - set(batches[500].tolist()))


def test_images_without_detail_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((480, 480), 90, np.uint8))
    monkeypatch.setattr("deepdetect_lab.training.scenes.ATTEMPTS", 1)
    with pytest.raises(OptionError, match="detail"):
        draw_numbered([tmp_path / "grey.png"], 2)
