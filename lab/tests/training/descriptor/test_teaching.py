from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from deepdetect.io.image import find_images
from deepdetect_lab.training.descriptor import teaching
from deepdetect_lab.training.descriptor.crops import Crops, draw_crops
from deepdetect_lab.training.descriptor.losses import contrastive_loss
from deepdetect_lab.training.descriptor.network import DescriptorNetwork
from deepdetect_lab.training.descriptor.task import draw_numbered, stack
from deepdetect_lab.training.descriptor.teaching import (
    crop_losses,
    measure_teaching,
    neighbours_differ,
)
from deepdetect_lab.training.descriptor.views import Pair
from deepdetect_lab.training.teachers.readings import Whitening


@pytest.fixture(scope="module")
def crops(textures: Path, made_readings: Path) -> Crops:
    drawn = draw_crops(find_images(textures), made_readings, 2, np.random.default_rng(0))
    return drawn._replace(codes=Whitening(sorted(made_readings.glob("*.npz")))(drawn.codes))


@pytest.fixture(scope="module")
def pairs(textures: Path) -> Pair:
    return stack([draw_numbered(find_images(textures), False, 0, k) for k in range(2)])


@pytest.fixture
def network() -> DescriptorNetwork:
    torch.manual_seed(0)
    return DescriptorNetwork()


def test_a_perfect_pupil_has_no_loss(
    network: DescriptorNetwork, crops: Crops, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(teaching, "turn", lambda code, angles: code)
    monkeypatch.setattr(network, "code", lambda features, xy: crops.codes)
    monkeypatch.setattr(network, "teach", torch.nn.Identity())
    monkeypatch.setattr(network, "scores", lambda *_: torch.logit(crops.survival, 1e-6))
    losses = crop_losses(network, crops)
    assert losses["codes"].item() == pytest.approx(0, abs=1e-3)
    for name in ("relations", "own neighbours", "neighbours"):
        assert losses[name].item() == pytest.approx(0, abs=1e-4)
    p = crops.survival.clamp(1e-6, 1 - 1e-6)
    entropy = -(p * p.log() + (1 - p) * (1 - p).log()).mean().item()
    assert losses["survival"].item() == pytest.approx(entropy, abs=1e-3)
    measures = measure_teaching(network, [crops])
    assert measures["teachers score"] == pytest.approx(1, abs=1e-3)
    assert measures["teachers found"] == 1
    assert measures["order score"] == pytest.approx(1, abs=1e-2)


def test_all_losses_reach_the_weights(
    network: DescriptorNetwork, crops: Crops, pairs: Pair
) -> None:
    losses = crop_losses(network, crops)
    assert sorted(losses) == ["codes", "neighbours", "own neighbours", "relations", "survival"]
    of_pairs = contrastive_loss(network, pairs, np.random.default_rng(0))
    sum(losses.values(), of_pairs).backward()
    without = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    # These layers begin with zeros, or act on zeros.
    assert all(name.startswith("by_size.0") for name in without)


def test_neighbours_differ_by_the_divergence_of_their_shares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(teaching, "SHARPNESS", 1.0)
    known, found = torch.tensor([[[0.5, 0.5], [0.9, 0.1]]]), torch.tensor([[[0.8, 0.2]] * 2])
    expected = (known * (known / found).log()).sum(-1).mean()
    # A constant for each row changes nothing.
    differs = neighbours_differ(found.log() + 3, known.log())
    torch.testing.assert_close(differs, expected)
