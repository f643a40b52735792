from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file

from deepdetect import OptionError, PointDetector
from deepdetect.io.image import find_images
from deepdetect_lab.networks.weights import load_network
from deepdetect_lab.training import DescriptorTrainingOptions, DeviceOptions, train_on_pairs
from deepdetect_lab.training.descriptor.edge import BACKBONE, EdgeNetwork
from deepdetect_lab.training.descriptor.export import export_descriptor
from deepdetect_lab.training.descriptor.losses import KINDS
from deepdetect_lab.training.descriptor.taught_task import TaughtTrainer
from deepdetect_lab.training.trainer import CHECKPOINT, TrainingResult

OPTIONS = DescriptorTrainingOptions(steps=3, pairs=2, crops=1, val_count=1, val_pairs=1)


def run(textures: Path, readings: Path, folder: Path) -> TrainingResult:
    how: Any = {"readings": readings, "device": "cpu"}
    return train_on_pairs(textures, textures, folder, OPTIONS, **how)


@pytest.fixture(scope="module", autouse=True)
def fast() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("deepdetect_lab.training.trainer.CHECKPOINT_INTERVAL_S", 0)
        patch.setattr("deepdetect_lab.training.descriptor.taught_task.VAL_CROPS", 1)
        yield


def test_an_interrupted_run_ends_with_the_same_weights(
    textures: Path, made_readings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run(textures, made_readings, tmp_path / "whole")
    counted = [f"{kind} correct" for kind in KINDS] + ["teachers score", "teachers found"]
    assert whole.best["score"] == pytest.approx(np.mean([whole.best[name] for name in counted]))
    assert "MIT" in (tmp_path / "whole/MODEL_CARD.md").read_text("utf-8")
    calls, step = iter(range(2)), TaughtTrainer.training_step

    def training_step(*arguments: Any) -> float:
        if next(calls, None) is None:
            raise KeyboardInterrupt
        return step(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(TaughtTrainer, "training_step", training_step)
        with pytest.raises(KeyboardInterrupt):
            run(textures, made_readings, tmp_path / "parts")
    assert run(textures, made_readings, tmp_path / "parts").points == whole.points
    first, second = (load_file(tmp_path / name / CHECKPOINT) for name in ("whole", "parts"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    again: Any = load_network(whole.weights, EdgeNetwork)
    assert isinstance(again, EdgeNetwork)
    points = PointDetector(64, descriptor=tmp_path / "whole/descriptor.onnx")
    assert points.extract(find_images(textures)[0]).descriptors.shape == (64, 64)


def test_crops_need_readings(textures: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="need `readings`"):
        train_on_pairs(textures, textures, tmp_path, OPTIONS)


def test_a_run_starts_from_the_published_layers(
    textures: Path, made_readings: Path, l64: Path
) -> None:
    images = find_images(textures)
    where = DeviceOptions(device="cpu")
    trainer = TaughtTrainer(images, images, OPTIONS, l64, where, made_readings)
    expected = EdgeNetwork()
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
    network = EdgeNetwork()
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
