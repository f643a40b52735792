from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from deepdetect.io.image import find_images
from deepdetect_lab.training.descriptor import teaching
from deepdetect_lab.training.descriptor.crops import Crops, draw_crops
from deepdetect_lab.training.descriptor.edge import EdgeNetwork
from deepdetect_lab.training.descriptor.network import turn
from deepdetect_lab.training.descriptor.task import draw_numbered, stack
from deepdetect_lab.training.descriptor.teaching import (
    angles_agree,
    crop_losses,
    measure_teaching,
    neighbours_differ,
    pair_losses,
    up_is_found,
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
def network() -> EdgeNetwork:
    torch.manual_seed(0)
    return EdgeNetwork()


def test_a_perfect_pupil_has_no_loss(
    network: EdgeNetwork, crops: Crops, pairs: Pair, monkeypatch: pytest.MonkeyPatch
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
    measures = measure_teaching(network, [crops], [pairs])
    assert measures["teachers score"] == pytest.approx(1, abs=1e-3)
    assert measures["teachers found"] > 0.9  # a point may be drawn twice
    assert measures["order score"] == pytest.approx(1, abs=1e-2)


@pytest.mark.parametrize("error", [0.0, 0.5])
def test_angles_agree_if_they_turn_as_the_views_do(pairs: Pair, error: float) -> None:
    first = torch.rand(pairs.turns.shape) * 6
    angles = torch.cat([first, first + pairs.turns + error])
    directions = torch.stack([angles.cos(), angles.sin()], -1) * 3
    torch.testing.assert_close(
        angles_agree(directions, pairs), torch.full_like(first, np.cos(error)), atol=1e-4, rtol=0
    )


def test_up_is_found_if_angles_are_those_of_the_turned_photographs(
    network: EdgeNetwork, crops: Crops, monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = crops.turn[:, None].expand(crops.sizes.shape)
    directions = torch.stack([turns.cos(), turns.sin()], -1).flatten(0, 1) * 2
    monkeypatch.setattr(network, "angle", torch.nn.Identity())
    found = up_is_found(network, directions, crops)
    torch.testing.assert_close(found, torch.ones_like(found))


def test_all_losses_reach_the_weights(network: EdgeNetwork, crops: Crops, pairs: Pair) -> None:
    losses = pair_losses(network, pairs, np.random.default_rng(0)) | crop_losses(network, crops)
    names = ["angles", "codes", "neighbours", "own neighbours", "pairs", "relations"]
    assert sorted(losses) == [*names, "survival", "up"]
    sum(losses.values(), torch.zeros(())).backward()
    without = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    # These layers begin with zeros, or act on zeros.
    assert all(name.startswith("by_size.0") for name in without)


def test_measures_of_angles_are_shares(
    network: EdgeNetwork, pairs: Pair, crops: Crops, monkeypatch: pytest.MonkeyPatch
) -> None:
    network.eval()
    measured = measure_teaching(network, [crops], [pairs])["angles correct"]
    monkeypatch.setattr(teaching, "RIGHT_COSINE", -1.1)
    assert measure_teaching(network, [crops], [pairs])["angles correct"] == 1
    assert 0 <= measured < 1


def test_long_descriptors_turn_as_short_ones() -> None:
    one = torch.rand(7, 64)
    parts = one.split([16, 24, 24], 1)
    # Each number twice: first those of the lowest frequency, as in `FREQUENCIES`.
    twice = torch.cat([part.repeat_interleave(2, 1) for part in parts], 1)
    angles = torch.rand(7)
    found: Any = turn(twice, angles)
    expected = turn(one, angles)
    torch.testing.assert_close(found[:, ::2], expected)
    torch.testing.assert_close(found[:, 1::2], expected)


def test_neighbours_differ_by_the_divergence_of_their_shares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(teaching, "SHARPNESS", 1.0)
    known, found = torch.tensor([[[0.5, 0.5], [0.9, 0.1]]]), torch.tensor([[[0.8, 0.2]] * 2])
    expected = (known * (known / found).log()).sum(-1).mean()
    # A constant for each row changes nothing.
    differs = neighbours_differ(found.log() + 3, known.log())
    torch.testing.assert_close(differs, expected)
