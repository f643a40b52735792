from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from deepdetect import OptionError
from deepdetect_lab.evaluation.masks import score_heatmap
from deepdetect_lab.labels import LabelOptions
from deepdetect_lab.networks.espnet import ESPNet
from deepdetect_lab.networks.fast import FastNetwork
from deepdetect_lab.networks.weights import NETWORKS
from deepdetect_lab.training.dataset import FolderSource, TrainingData
from deepdetect_lab.training.dense import (
    DenseTrainer,
    freeze_batch_norm,
    initial_network,
)
from deepdetect_lab.training.recipe import DeviceOptions, Stage, TrainingOptions

from .conftest import plain_options

PLAIN = DeviceOptions("cpu", "float32", compile=False, threads=1)


def make_trainer(
    network: torch.nn.Module, device: DeviceOptions = PLAIN, **options: object
) -> DenseTrainer:
    """A trainer of 150 steps without warm-up, at a learning rate of 0.1 falling to nothing."""
    values = {"stages": (Stage(16, 1, 150),), "learning_rate": 0.1, **options}
    source, recipe = FolderSource([None], Path(), LabelOptions()), plain_options(**values)
    return DenseTrainer(network, recipe, TrainingData(source, source, ""), device)


class Constant(torch.nn.Module):
    """A network that knows nothing but how much is marked."""

    def __init__(self) -> None:
        super().__init__()
        self.logit = torch.nn.Parameter(torch.zeros(()))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.logit.expand(len(image), 1, *image.shape[2:])


@pytest.mark.parametrize(("marked_rows", "weight"), [(4, 1.0), (4, 1.3), (12, 2.0)])
def test_a_marked_pixel_counts_by_its_weight(marked_rows: int, weight: float) -> None:
    """The least loss of a constant is at the odds of the marked pixels times the weight there."""
    trainer = make_trainer(Constant(), pos_weight=weight)
    rgb = torch.zeros((2, 16, 16, 3), dtype=torch.uint8)
    masks = torch.zeros((2, 16, 16), dtype=torch.bool)
    masks[:, :marked_rows] = True
    share = marked_rows / 16
    first = trainer.training_step((rgb, masks), 0)
    assert first == pytest.approx(math.log(2) * (1 - share + share * weight), rel=1e-5)
    for step in range(1, 150):
        trainer.training_step((rgb, masks), step)
    logit = trainer.network.logit.item()
    assert logit == pytest.approx(math.log(weight * share / (1 - share)), abs=0.01)


def test_dark_images_have_a_weight_of_their_own() -> None:
    """Half of the crops are dark: the first loss is the mean of both kinds."""
    trainer = make_trainer(Constant(), pos_weight=3.0, low_light_pos_weight=1.0)
    rgb = torch.zeros((2, 16, 16, 3), dtype=torch.uint8)
    spans = torch.tensor([200, 40], dtype=torch.uint8)  # in grey levels
    rgb[:, 8:] = spans[:, None, None, None]
    masks = torch.zeros((2, 16, 16), dtype=torch.bool)
    masks[0, :8] = True
    only_in_normal = trainer.training_step((rgb, masks), 0)
    assert only_in_normal == pytest.approx(math.log(2) * (2.0 + 1.0) / 2, rel=1e-5)
    only_in_dark = trainer.training_step((rgb, masks.flip(0)), 1)
    assert only_in_dark == pytest.approx(math.log(2), rel=1e-5)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    trainer = make_trainer(Constant())
    with torch.no_grad():
        trainer.network.logit.fill_(float("inf"))
    rgb = torch.zeros((1, 16, 16, 3), dtype=torch.uint8)
    masks = torch.zeros((1, 16, 16), dtype=torch.bool)
    with pytest.raises(OptionError, match="`learning_rate`"):
        trainer.training_step((rgb, masks), 7)


@pytest.mark.parametrize("size", [(16, 16), (21, 30)])
def test_a_heatmap_of_any_size(size: tuple[int, int]) -> None:
    heatmap = make_trainer(Constant()).heatmap(torch.zeros((*size, 3), dtype=torch.uint8))
    assert heatmap.shape == size
    assert (heatmap == 0.5).all()


def test_another_network_is_a_line_of_the_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(NETWORKS, "constant", Constant)
    network = initial_network(TrainingOptions(network="constant"), None)[1]
    assert isinstance(network, Constant)
    with pytest.raises(OptionError, match="'espnet'"):
        initial_network(TrainingOptions(network="esp"), None)


def test_what_is_measured_follows_the_weights() -> None:
    """The mean decays as told, at first faster, and holds the batch statistics, too."""
    torch.manual_seed(0)
    trainer = make_trainer(FastNetwork(), average_decay=0.2, learning_rate=1e-3, optimizer="soap")
    rgb = torch.randint(0, 256, (2, 32, 32, 3), dtype=torch.uint8)
    expected = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    for step in range(4):
        trainer.training_step((rgb, rgb[..., 0] > 128), step)
        decay = min(0.2, (1 + step) / (10 + step))
        for name, value in trainer.network.state_dict().items():
            mean = expected[name] * decay + value * (1 - decay)
            expected[name] = mean if value.is_floating_point() else value.clone()
    for name, value in trainer.average.state_dict().items():
        torch.testing.assert_close(value, expected[name], rtol=1e-5, atol=1e-7)
    assert not torch.equal(trainer.average.logits.weight, trainer.network.logits.weight)
    image, network = rgb[0, :16], trainer.average
    with torch.inference_mode():
        logits = network(trainer.to_float(image[None]))[0, 0]
    np.testing.assert_allclose(trainer.heatmap(image), logits.sigmoid(), atol=1e-6)


def test_without_a_decay_the_weights_themselves_are_measured() -> None:
    trainer = make_trainer(ESPNet(), frozen_batch_norm=False)
    rgb = torch.randint(0, 256, (2, 32, 32, 3), dtype=torch.uint8)
    trainer.training_step((rgb, rgb[..., 0] > 128), 0)
    states = trainer.average.state_dict(), trainer.network.state_dict()
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[1])


def test_gradients_are_scaled_down_to_the_norm_they_may_have() -> None:
    torch.manual_seed(0)
    rgb = torch.randint(0, 256, (2, 32, 32, 3), dtype=torch.uint8)
    norms = []
    for limit in (None, 1e-3):
        trainer = make_trainer(FastNetwork(), max_gradient_norm=limit, optimizer="adam")
        trainer.training_step((rgb, rgb[..., 0] > 128), 0)
        gradients = [parameter.grad.flatten() for parameter in trainer.network.parameters()]
        norms.append(float(torch.cat(gradients).norm()))
    assert norms[0] > 1e-2
    assert norms[1] == pytest.approx(1e-3, rel=1e-4)


def gradients(trainer: DenseTrainer, images: torch.Tensor, truth: torch.Tensor) -> list:
    trainer.network.train()
    trainer.network.zero_grad()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(trainer.logits(images), truth)
    loss.backward()
    return [parameter.grad.clone() for parameter in trainer.network.parameters()]


def two_trainers(side: int, options: DeviceOptions) -> tuple[list[torch.Tensor], ...]:
    """Return the gradients of one network, by an eager trainer in float32 and by another one."""
    torch.manual_seed(0)
    first, second = ESPNet(), ESPNet()
    second.load_state_dict(first.state_dict())
    rgb = torch.randint(0, 256, (2, side, side, 3), dtype=torch.uint8)
    truth = (torch.rand(2, 1, side, side) < 0.4).float()
    plain = make_trainer(first, DeviceOptions("cpu", "float32", compile=False))
    other = make_trainer(second, options)
    return tuple(gradients(trainer, trainer.to_float(rgb), truth) for trainer in (plain, other))


def test_gradients_in_bfloat16_are_those_of_float32_within_rounding() -> None:
    expected, found = two_trainers(96, DeviceOptions("cpu", "bfloat16", compile=False))
    a, b = (torch.cat([gradient.flatten() for gradient in each]) for each in (expected, found))
    assert torch.isfinite(b).all()
    assert torch.nn.functional.cosine_similarity(a, b, dim=0) > 0.97
    assert (a - b).norm() / a.norm() < 0.25


def test_a_compiler_that_does_not_work_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object) -> torch.Tensor:
        raise torch._dynamo.exc.TorchDynamoException("Python.h is missing")

    monkeypatch.setattr(torch, "compile", lambda *arguments, **options: broken)
    monkeypatch.setattr("shutil.which", lambda name: "/usr/bin/g++")
    images = torch.rand(1, 3, 32, 32)
    trainer = make_trainer(ESPNet(), DeviceOptions("cpu", "float32"))
    assert trainer.compiled
    assert trainer.logits(images).shape == (1, 1, 32, 32)
    assert "eager" in trainer.describe()
    with pytest.raises(OptionError, match="compile="):
        make_trainer(ESPNet(), DeviceOptions("cpu", "float32", compile=True)).logits(images)


def test_frozen_batch_norm_keeps_its_statistics() -> None:
    network = torch.nn.Sequential(torch.nn.BatchNorm2d(3), torch.nn.Dropout(0.5)).train()
    freeze_batch_norm(network)
    network(torch.rand(2, 3, 8, 8))
    assert torch.equal(network[0].running_mean, torch.zeros(3))
    assert network[1].training


def test_the_loss_of_masks_is_torch_s() -> None:
    rng = np.random.default_rng(0)
    logits, mask = rng.normal(0, 3, (32, 32)).astype(np.float32), rng.random((32, 32)) < 0.3
    expected = torch.nn.functional.binary_cross_entropy_with_logits(
        torch.from_numpy(logits), torch.from_numpy(mask).float()
    )
    loss, _ = score_heatmap(1 / (1 + np.exp(-logits)), mask)
    assert loss == pytest.approx(float(expected), abs=1e-5)
