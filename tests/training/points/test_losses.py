"""The losses beside what they are made of, and blind to the scale of the logits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from deepdetect.detector.points import PyramidOptions, detect_points, pyramid
from deepdetect.training.points.candidates import Candidates, find_candidates
from deepdetect.training.points.losses import (
    Direction,
    choose_softly,
    mutual_pairs,
    pair_loss,
    project,
)
from deepdetect.training.points.recipe import LOSSES, PointsTrainingOptions

from .conftest import texture

VALID = np.ones((96, 96), bool)


def levels_of(seed: int, shift: int = 0) -> list[torch.Tensor]:
    image = np.roll(texture(seed, 96), shift, axis=1).astype(np.float32) / 255
    maps = pyramid(cv2.GaussianBlur(image, (0, 0), 1.5), PyramidOptions(levels=3))
    return [torch.from_numpy(level).requires_grad_() for level in maps]


def both_ways(first, second, homography=np.eye(3)) -> tuple[Direction, Direction]:
    views = [find_candidates(levels, VALID, 25.0) for levels in (first, second)]
    back = np.linalg.inv(homography)
    return Direction(*views, homography, VALID), Direction(*views[::-1], back, VALID)


def test_candidates_are_the_points_of_run_time() -> None:
    levels = levels_of(0)
    found = find_candidates(levels, VALID, 25.0)
    gray = texture(0, 96)
    maps = iter(level.detach().numpy() for level in levels)
    points = detect_points(gray, lambda level: next(maps), PyramidOptions(levels=3))
    inner = (points.xy > 8).all(1) & (points.xy < 87).all(1)
    ours = found.xy.detach().numpy()
    gaps = np.linalg.norm(points.xy[inner][:, None] - ours[None], axis=2).min(1)
    assert inner.sum() > 20
    assert np.quantile(gaps, 0.95) < 1e-3


def test_logits_of_candidates_have_a_fixed_spread() -> None:
    levels = levels_of(1)
    plain, sharp = (
        find_candidates([factor * level + 3 for level in levels], VALID, 25.0) for factor in (1, 40)
    )
    assert float(plain.logits.detach().std()) == pytest.approx(25, rel=1e-3)
    torch.testing.assert_close(plain.logits, sharp.logits, rtol=1e-3, atol=0.02)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_loss_has_no_gradient_along_the_scale(loss: str) -> None:
    options = PointsTrainingOptions(loss=loss)
    factor = torch.ones((), requires_grad=True)
    first, second = levels_of(2), levels_of(2, shift=1)
    ways = both_ways([factor * level for level in first], [factor * level for level in second])
    pair_loss(*ways, 0.003, options).backward()
    along = float(factor.grad)
    across = max(float(level.grad.norm()) for level in (*first, *second))
    assert abs(along) < 1e-3 * max(1.0, across)
    assert across > 1e-4


@pytest.mark.parametrize("loss", LOSSES)
def test_the_same_view_twice_is_better_than_two_strangers(loss: str) -> None:
    options = PointsTrainingOptions(loss=loss)
    same = pair_loss(*both_ways(levels_of(3), levels_of(3)), 0.01, options)
    other = pair_loss(*both_ways(levels_of(3), levels_of(4)), 0.01, options)
    assert float(same.detach()) < float(other.detach())


@pytest.mark.parametrize("budget", [5, 40.0, 1e9])
def test_the_soft_choice_meets_its_budget(budget: float) -> None:
    logits = 25 * torch.randn(100, generator=torch.Generator().manual_seed(0))
    chosen = choose_softly(logits, budget, 3.0)
    assert float(chosen.sum()) == pytest.approx(min(budget, 100), rel=0.02)


def test_descent_ranks_what_is_found_again_first() -> None:
    """Ten candidates of fifty have partners; both losses rank these first (two by chance)."""
    generator = np.random.default_rng(0)
    xy = [torch.tensor(generator.uniform(5, 90, (50, 2)), dtype=torch.float32) for _ in range(2)]
    xy[1][:10] = xy[0][:10] + 0.3
    for loss in LOSSES:
        raw = [torch.tensor(generator.normal(size=50), dtype=torch.float32) for _ in range(2)]
        for each in raw:
            each.requires_grad_()
        optimizer = torch.optim.Adam(raw, 0.05)
        options = PointsTrainingOptions(loss=loss, position_weight=0)
        for _ in range(150):
            views = [
                Candidates(p, 25 * (z - z.mean()) / z.std()) for p, z in zip(xy, raw, strict=True)
            ]
            ways = Direction(*views, np.eye(3), VALID), Direction(*views[::-1], np.eye(3), VALID)
            optimizer.zero_grad()
            pair_loss(*ways, generator.uniform(4, 20) / VALID.size, options).backward()
            optimizer.step()
        for each in raw:
            best = each.detach().argsort(descending=True)[:10]
            assert (best < 10).float().mean() > 0.5, loss


def test_partners_are_mutual_and_positions_projected() -> None:
    homography = np.array([[1.2, 0.1, 3], [-0.1, 0.9, 2], [1e-4, 2e-4, 1]])
    xy = torch.tensor([[10.0, 20], [40, 50], [41, 50], [70, 30]])
    there = torch.cat([project(xy[[3, 1, 0]], homography), torch.tensor([[1.0, 1.0]])])
    views = [Candidates(p, torch.zeros(4)) for p in (xy, there)]
    rows, partners, distance = mutual_pairs(Direction(*views, homography, VALID), 3.0)
    assert dict(zip(rows.tolist(), partners.tolist(), strict=True)) == {0: 2, 1: 1, 3: 0}
    np.testing.assert_allclose(distance, 0, atol=1e-4)
