from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
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
from deepdetect_lab.training.descriptor.export import export_descriptor
from deepdetect_lab.training.descriptor.losses import KINDS, shares_right
from deepdetect_lab.training.descriptor.network import BACKBONE, DescriptorNetwork
from deepdetect_lab.training.descriptor.task import (
    DescriptorTrainer,
    draw_numbered,
    pairs_of_step,
    pairs_to_draw,
    validation_batches,
)
from deepdetect_lab.training.trainer import CHECKPOINT

OPTIONS = DescriptorTrainingOptions(steps=3, pairs=2, val_count=1, val_pairs=1)


def run(
    textures: Path, folder: Path, options: DescriptorTrainingOptions = OPTIONS, **how: Any
) -> TrainingResult:
    return train_on_pairs(textures, textures, folder, options, device="cpu", **how)


@pytest.fixture(scope="module", autouse=True)
def checkpoints_at_every_step() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deepdetect_lab.training.trainer.CHECKPOINT_INTERVAL_S", 0)
        patch.setattr("deepdetect_lab.training.descriptor.task.VAL_CROPS", 1)
        yield


@pytest.fixture(scope="module")
def whole(textures: Path, tmp_path_factory) -> TrainingResult:
    return run(textures, tmp_path_factory.mktemp("whole"))


def test_training_changes_the_weights_and_measures(whole: TrainingResult) -> None:
    after = load_file(whole.weights.parent / CHECKPOINT)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        before = DescriptorNetwork()
    kept = [n for n, p in before.named_parameters() if (after[f"network.{n}"] == p).all()]
    assert kept
    assert all(name.startswith(("score", "teach")) for name in kept)  # only teachers need these
    assert [point["step"] for point in whole.points] == [3]
    shares = [whole.best[f"{kind} correct"] for kind in KINDS]
    assert whole.best["score"] == pytest.approx(np.mean(shares))
    assert (whole.weights.parent / "MODEL_CARD.md").is_file()


@pytest.mark.parametrize("crops", [0, 1])
def test_an_interrupted_run_ends_with_the_same_weights(
    crops: int,
    whole: TrainingResult,
    textures: Path,
    made_readings: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    how: Any = {"options": replace(OPTIONS, crops=crops), "readings": made_readings}
    if crops:
        whole = run(textures, tmp_path / "whole", **how)
        counted = [f"{kind} correct" for kind in KINDS] + ["teachers score", "teachers found"]
        assert whole.best["score"] == pytest.approx(np.mean([whole.best[name] for name in counted]))
        assert "MIT" in (tmp_path / "whole/MODEL_CARD.md").read_text("utf-8")
    calls, step = iter(range(2)), DescriptorTrainer.training_step

    def training_step(*arguments: Any) -> float:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return step(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(DescriptorTrainer, "training_step", training_step)
        with pytest.raises(KeyboardInterrupt):
            run(textures, tmp_path, **how)
    assert read_checkpoint(tmp_path / CHECKPOINT)[1]["step"] == 2
    assert run(textures, tmp_path, **how).points == whole.points
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


def test_crops_need_readings(textures: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="need `readings`"):
        run(textures, tmp_path, replace(OPTIONS, crops=1))


def test_a_run_starts_from_the_published_layers(
    textures: Path, made_readings: Path, l64: Path
) -> None:
    images = find_images(textures)
    where = DeviceOptions(device="cpu")
    trainer = DescriptorTrainer(
        images, images, replace(OPTIONS, crops=1), l64, where, made_readings
    )
    expected = DescriptorNetwork()
    expected.start_from(l64)
    started = [name for name, _ in expected.named_parameters() if name.startswith(BACKBONE)]
    for name in started:
        assert torch.equal(trainer.network.get_parameter(name), expected.get_parameter(name))
    rates = {
        parameter: group["rate_factor"]
        for optimizer in trainer.optimizers
        for group in optimizer.param_groups
        for parameter in group["params"]
    }
    names = "block_eighth.first.weight", "input.weight", "at_half.weight", "input.bias"
    found = [rates[trainer.network.get_parameter(name)] for name in names]
    assert found == [0.5, 1, 0.2, 0.4]
    trainer.steps = 1000
    rate = trainer.options.learning_rate
    found = [trainer.learning_rate(step) / rate for step in (0, 160, 590, 1000)]
    assert found == pytest.approx([1 / 150, 1, 0.5, 0])


def test_an_onnx_file_gives_the_same_numbers(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = DescriptorNetwork()
    with torch.no_grad():
        for norm in (network.norm, network.middle_norm):
            for values in (norm.weight, norm.bias, norm.running_mean, norm.running_var):
                assert values is not None
                values.uniform_(0.5, 2)
    network.eval()
    export_descriptor(network, tmp_path / "descriptor.onnx")
    session = onnxruntime.InferenceSession(
        tmp_path / "descriptor.onnx", providers=["CPUExecutionProvider"]
    )
    luma, xy, sizes = torch.rand(1, 1, 256, 256), torch.rand(1, 40, 2) * 255, torch.rand(1, 40) * 30
    with torch.no_grad():
        expected = network(luma, xy, sizes)
    inputs = {"luma": luma.numpy(), "xy": xy.numpy(), "sizes": sizes.numpy()}
    (found,) = session.run(None, inputs)
    np.testing.assert_allclose(found, expected.numpy(), atol=5e-3)  # kernels are float16
    assert expected.shape == (1, 40, 64)
