"""Sparse matches along epipolar lines, against a search in plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.matching.guided import epipolar_search as module
from deepdetect.matching.guided.epipolar_search import (
    _poisson_tail,
    epipolar_search,
    log10_p_value,
)

ROWS = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""The fundamental matrix of a rectified pair, whose epipolar lines are the rows."""

SIZE = (400, 300)


def keypoints(xy: np.ndarray, descriptors: np.ndarray) -> Keypoints:
    return Keypoints(xy, np.ones(len(xy)), SIZE, descriptors=descriptors.astype(np.uint8))


def random_pair(count: int, seed: int = 0) -> tuple[Keypoints, Keypoints]:
    """Return keypoints that moved along their rows, with a little noise, and others."""
    generator = np.random.default_rng(seed)
    xy = generator.uniform((0, 0), SIZE, (count, 2))
    described = generator.integers(0, 256, (count, 128))
    moved = xy + np.column_stack([generator.uniform(-40, 40, count), generator.normal(0, 1, count)])
    noisy = np.clip(described + generator.normal(0, 30, described.shape), 0, 255)
    others = generator.random(count) < 0.3
    noisy[others] = generator.integers(0, 256, (others.sum(), 128))
    order = generator.permutation(count)
    return keypoints(xy, described), keypoints(moved[order], noisy[order])


def by_loops(first: Keypoints, second: Keypoints) -> list[tuple]:
    """Search as the documentation says it, one keypoint at a time; lines are the rows."""
    a, b = first.descriptors.astype(float), second.descriptors.astype(float)
    distance = np.stack([np.linalg.norm(one - b, axis=1) for one in a])
    near = np.abs(first.xy[:, None, 1] - second.xy[None, :, 1]) < module.MAX_DISTANCE_PX
    inside, outside = np.where(near, distance, np.inf), np.where(near, np.inf, distance)
    found = []
    for row in range(len(a)):
        best = int(inside[row].argmin())
        if not near[row, best] or inside[:, best].argmin() != row:
            continue
        apart = np.linalg.norm(second.xy - second.xy[best], axis=1) >= module.MIN_SEPARATION_PX
        rivals = [outside[row].min(), outside[:, best].min()]
        passes = inside[row, best] < module.MAX_RATIO_ELSEWHERE * min(rivals)
        second_best = inside[row][apart].min(initial=np.inf)
        if passes and inside[row, best] < module.MAX_RATIO_NEAR * second_best:
            found.append((*first.xy[row], *second.xy[best]))
    return found


@pytest.mark.parametrize("count", [60, 700])
@pytest.mark.parametrize("ratio", [0.6, 0.95])
def test_finds_what_plain_loops_find(
    count: int, ratio: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = random_pair(count)
    monkeypatch.setattr(module, "MAX_RATIO_ELSEWHERE", ratio)
    found = epipolar_search(first, second, ROWS)
    expected = by_loops(first, second)
    assert len(expected) > 20
    np.testing.assert_allclose(np.column_stack(found), expected, atol=1e-6)


def test_right_lines_find_more_than_chance() -> None:
    first, second = random_pair(300)
    nothing = np.empty((0, 2))
    assert log10_p_value(first, second, ROWS, nothing) < -10
    columns = np.array([[0, 0, 1.0], [0, 0, 0], [-1.0, 0, 0]])
    assert log10_p_value(first, second, columns, nothing) > -2


def test_matches_that_a_geometry_came_from_are_no_evidence() -> None:
    first, second = random_pair(300)
    used = epipolar_search(first, second, ROWS)[0]
    assert log10_p_value(first, second, ROWS, used) == 0


def test_unrelated_keypoints_are_explained_by_chance() -> None:
    for seed in range(10):
        first, _ = random_pair(300, seed)
        _, second = random_pair(300, seed + 100)
        assert log10_p_value(first, second, ROWS, np.empty((0, 2))) > -3


@pytest.mark.parametrize("mean", [1.0, 3.25, 77.5, 3000.5])
def test_the_tail_of_a_poisson_variable(mean: float) -> None:
    special = pytest.importorskip("scipy.special", reason="compares with scipy")
    for count in (1, 2, 10, 77, 78, 200, 2900, 3001, 3300):
        expected = float(special.pdtrc(count - 1, mean))
        if expected > 1e-300:
            assert _poisson_tail(count, mean) == pytest.approx(expected, rel=1e-9)
    assert _poisson_tail(0, mean) == 1
