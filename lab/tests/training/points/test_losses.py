from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from deepdetect.detector.points.candidate_features import FEATURES
from deepdetect_lab.training.points import losses, pairs
from deepdetect_lab.training.points.losses import mutual_pairs, pair_loss, soft_top_k
from deepdetect_lab.training.points.pairs import CandidatePair, ViewCandidates, candidate_pair
from deepdetect_lab.training.points.views import ViewPair


@pytest.fixture(autouse=True)
def soft(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(losses, "TEMPERATURE", 3.0)


COUNT, REPEATED, BUDGET = 60, 30, 20


class FirstFeature(torch.nn.Module):
    """Ranks by a parameter for each candidate; a stand-in for a ranker that knows them all."""

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.logits = torch.nn.Parameter(torch.randn(COUNT, generator=generator))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.logits[features[:, 0].long()]


def known_pair(distance_px: float = 0.3) -> CandidatePair:
    """Candidates far from each other; the first half of them are seen in both views."""
    grid = np.stack(np.meshgrid(np.arange(10), np.arange(6)), -1).reshape(-1, 2) * 10.0
    features = np.zeros((COUNT, FEATURES), np.float32)
    features[:, 0] = np.arange(COUNT)
    rows = np.arange(REPEATED)
    view = ViewCandidates(
        xy=grid,
        sigma_px=np.ones(COUNT),
        features=features,
        visible=np.ones(COUNT, bool),
        first=rows,
        second=rows,
        distance_px=np.full(REPEATED, distance_px),
    )
    return CandidatePair((view, view), BUDGET)


def value(ranker, pair) -> float:
    return pair_loss(ranker, pair).item()


def test_the_soft_choice_sums_to_the_budget() -> None:
    logits = torch.linspace(-50, 50, 101)
    chosen = soft_top_k(logits, 20, 3.0)
    assert float(chosen.sum()) == pytest.approx(20, abs=0.01)
    assert (chosen.diff() >= 0).all()


def test_training_brings_repeated_candidates_to_the_top() -> None:
    ranker, pair = FirstFeature(), known_pair()
    optimizer = torch.optim.Adam(ranker.parameters(), 0.15)
    before = value(ranker, pair)
    for _ in range(60):
        optimizer.zero_grad()
        loss = pair_loss(ranker, pair)
        loss.backward()
        optimizer.step()
    assert before > -0.6
    assert loss.item() < -0.7
    best = torch.argsort(ranker.logits, descending=True)[:BUDGET]
    assert (best < REPEATED).float().mean() >= 0.7  # .5 by chance


def test_the_loss_does_not_see_the_scale_of_the_logits() -> None:
    ranker, pair = FirstFeature(), known_pair()
    first = value(ranker, pair)
    with torch.no_grad():
        ranker.logits.mul_(7).add_(3)
    assert value(ranker, pair) == pytest.approx(first, abs=1e-3)


def test_close_partners_are_worth_more() -> None:
    ranker = FirstFeature()
    close, near = (value(ranker, known_pair(d)) for d in (0.5, 2.0))
    assert near == pytest.approx(close * (1 - losses.CLOSE_SHARE), rel=0.01)


def test_mutual_pairs_are_each_others_nearest() -> None:
    view = dataclasses.replace(
        known_pair().views[0],
        first=np.array([0, 0, 1, 2]),
        second=np.array([5, 6, 6, 7]),
        distance_px=np.array([1.0, 0.5, 0.2, 2.5]),
    )
    everyone = np.ones(3, bool), np.ones(8, bool)
    assert mutual_pairs(view, 3.0, *everyone).tolist() == [2, 3]
    assert mutual_pairs(view, 2.0, *everyone).tolist() == [2]
    without = np.array([True, False, True]), everyone[1]
    assert sorted(mutual_pairs(view, 3.0, *without).tolist()) == [1, 3]


def test_candidates_of_the_same_view_see_each_other(photo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "MAX_CANDIDATES", 300)
    side = 128
    image, valid = photo[:side, :side], np.ones((side, side), bool)
    valid[:, :20] = False
    images = ViewPair((image, image), (valid, valid), np.eye(3), "light")
    pair = candidate_pair(images, 0.01)
    assert pair.budget == pytest.approx(0.01 * side**2)
    assert len(pair.views[0].xy) == 300
    assert pair.views[0].xy[:, 0].min() > 19
    for view in pair.views:
        assert view.visible.all()
        itself = view.first == view.second
        assert itself.sum() == 300
        assert (view.distance_px[itself] == 0).all()
        assert view.distance_px[~itself].min() > 0


def test_views_of_nothing_have_no_candidates() -> None:
    empty, valid = np.zeros((64, 64), np.uint8), np.ones((64, 64), bool)
    pair = candidate_pair(ViewPair((empty, empty), (valid, valid), np.eye(3), "blur"), 0.01)
    for view in pair.views:
        assert len(view.xy) == len(view.visible) == len(view.first) == 0


def test_a_shift_is_followed(photo) -> None:
    side = 128
    images = photo[:side, :side], photo[5 : side + 5, 9 : side + 9]
    valid = np.ones((side, side), bool)
    shift = np.array([[1, 0, -9], [0, 1, -5], [0, 0, 1.0]])
    view = candidate_pair(ViewPair(images, (valid, valid), shift, "light"), 0.01).views[0]
    seen = view.xy - (9, 5)
    inside = ((seen > -0.5) & (seen < side - 0.5)).all(1)
    np.testing.assert_array_equal(view.visible, inside)
    assert len(np.unique(view.first[view.distance_px < 0.05])) > 0.5 * inside.sum()
