from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from deepdetect_lab.training.descriptor import losses
from deepdetect_lab.training.descriptor.losses import contrastive_loss, mirror, shares_right
from deepdetect_lab.training.descriptor.network import DescriptorNetwork, turn
from deepdetect_lab.training.descriptor.task import stack
from deepdetect_lab.training.descriptor.views import KEYPOINTS, Pair
from deepdetect_lab.training.scenes import SIDE_PX


@pytest.fixture(autouse=True)
def exact_angles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "ANGLE_NOISE", 0.0)


def made_batch(angle: float = 0.0, zoom: float = 0.0, valid: int = 100) -> Pair:
    """Keypoints on a grid, at the same places in both views; `valid` of them count."""
    image = np.random.default_rng(1).integers(0, 255, (SIDE_PX, SIDE_PX), np.uint8)
    grid = np.stack(np.meshgrid(*[8 + 15 * np.arange(16, dtype=np.float32)] * 2), -1).reshape(-1, 2)
    sizes, turns = np.full((2, KEYPOINTS), [[5], [angle]], np.float32)
    kept, whole = np.arange(KEYPOINTS) < valid, (np.float32(angle), np.float32(zoom))
    return stack([Pair(np.stack([image, image]), grid, grid, sizes, sizes, turns, kept, *whole)])


def describing(monkeypatch: pytest.MonkeyPatch, first: torch.Tensor, second: torch.Tensor) -> Any:
    """Let the network describe as given; the similarities are multiplied by 10."""
    monkeypatch.setattr(losses, "describe_views", lambda network, batch: (first, second))
    network = DescriptorNetwork().eval()
    with torch.no_grad():
        network.temperature.fill_(np.log(10.0))
    return network


def unit(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(1, KEYPOINTS, 64, generator=generator), dim=-1)


def swapped(descriptors: torch.Tensor) -> torch.Tensor:
    """The first two change places."""
    return descriptors[:, [1, 0, *range(2, KEYPOINTS)]]


def loss(network: Any, batch: Pair) -> float:
    return contrastive_loss(network, batch, np.random.default_rng(0)).item()


def test_the_loss_is_the_cross_entropy_of_the_valid_keypoints(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = unit(1), unit(2)
    z = (10 * first[0, :100] @ second[0, :100].T).double().numpy()
    forth, back = (-np.diag(z - np.log(np.exp(z).sum(k, keepdims=True))).mean() for k in (1, 0))
    found = loss(describing(monkeypatch, first, second), made_batch())
    assert found == pytest.approx((forth + back) / 2, rel=1e-4)


def test_near_keypoints_are_not_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    network, batch = describing(monkeypatch, unit(1), swapped(unit(1))), made_batch(valid=2)
    assert loss(network, batch) > 5
    batch.positions1[0, 1] = batch.positions1[0, 0] + 2
    assert loss(network, batch) == pytest.approx(0, abs=1e-4)


def test_turned_descriptors_are_turned_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "mirror", lambda batch, which: batch)
    first, batch = unit(1), made_batch(angle=2.0)
    turned = loss(describing(monkeypatch, first, turn(first, batch.turns)), batch)
    upright = loss(describing(monkeypatch, first, first), made_batch())
    assert turned == pytest.approx(upright, rel=1e-4)


def test_the_measure_counts_mutual_right_matches_by_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    # Two of a hundred are wrong; and nothing was turned, but what is said to be is turned back.
    network = describing(monkeypatch, unit(1), swapped(unit(1)))
    batches = [made_batch(), made_batch(zoom=1.0), made_batch(angle=np.pi / 2)]
    shares = shares_right(network, batches)
    assert shares["upright correct"] == shares["zoomed correct"] == pytest.approx(0.98)
    assert shares["turned correct"] < 0.9


def test_mirrored_pairs_show_the_same_keypoints_mirrored() -> None:
    batch = made_batch(angle=0.3)
    once = mirror(batch, torch.tensor([True]))
    x, y = batch.positions0[0, 7].long()
    assert once.images[0, 0, y, SIDE_PX - 1 - x] == batch.images[0, 0, y, x]
    assert once.positions0[0, 7].tolist() == [SIDE_PX - 1 - x, y]
    assert once.turns[0, 7] == -batch.turns[0, 7]
    for other in (mirror(once, torch.tensor([True])), mirror(batch, torch.tensor([False]))):
        assert all(torch.equal(a, b) for a, b in zip(other, batch, strict=True))
