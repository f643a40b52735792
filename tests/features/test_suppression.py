from __future__ import annotations

import numpy as np
import pytest

from deepdetect.features import suppression
from deepdetect.features.suppression import suppress_neighbors


@pytest.mark.parametrize("radius", [0.7, 2.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_as_a_search_among_all_kept_ones(radius: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.uniform(-3, 30, (300, 2)).astype(np.float32)
    scores = generator.integers(20, size=300)
    kept: list[int] = []
    for row in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(xy[kept].astype(float) - xy[row].astype(float), axis=1)
        if not len(kept) or gaps.min() >= radius:
            kept.append(int(row))
    assert suppress_neighbors(xy, scores, radius).tolist() == kept


@pytest.mark.parametrize("seed", range(3))
def test_of_two_radii_the_smaller_one_counts(seed: int) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.uniform(-3, 30, (300, 2))
    scores, radii = generator.uniform(size=300), generator.uniform(0.5, 6, 300)
    kept: list[int] = []
    for row in np.argsort(-scores):
        gaps = np.linalg.norm(xy[kept] - xy[row], axis=1)
        if (gaps >= np.minimum(radii[kept], radii[row])).all():
            kept.append(int(row))
    assert suppress_neighbors(xy, scores, radii).tolist() == kept


@pytest.mark.parametrize("radius", [0.7, 3.0, "own"])
def test_compiled_and_not_are_the_same(
    radius: float | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(0)
    xy, scores = generator.uniform(-3, 99, (3000, 2)), generator.integers(500, size=3000)
    radii = generator.choice([2.0, 2.7, 3.7, 9.1], 3000) if radius == "own" else radius
    found = []
    for least in (0, 10**9):
        monkeypatch.setattr(suppression, "MIN_COMPILED_POINTS", least)
        found.append(suppress_neighbors(xy, scores, radii).tolist())
    assert found[0] == found[1]
