from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from deepdetect.features import spacing
from deepdetect.features.spacing import grid_subsample, suppress_neighbors


def test_grid_subsample_takes_one_of_each_cell() -> None:
    points = np.random.default_rng(0).uniform(0, 100, (5000, 2))
    rows = grid_subsample(points, 10)
    assert len(rows) == 100
    assert len(np.unique(points[rows] // 10, axis=0)) == 100
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, grid_subsample(points, 10))
    assert (rows != grid_subsample(points, 10, seed=1)).any()


@pytest.mark.parametrize("least", [0, 10**9], ids=["compiled", "not compiled"])
@pytest.mark.parametrize("seed", range(3))
def test_of_two_radii_the_smaller_one_counts(
    seed: int, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spacing, "MIN_COMPILED_POINTS", least)
    monkeypatch.setattr(spacing, "sys", SimpleNamespace(modules={}))
    generator = np.random.default_rng(seed)
    xy = generator.uniform(-3, 30, (300, 2))
    scores, radii = generator.integers(20, size=300), generator.uniform(0.5, 6, 300)
    kept: list[int] = []
    for row in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(xy[kept] - xy[row], axis=1)
        if (gaps >= np.minimum(radii[kept], radii[row])).all():
            kept.append(int(row))
    assert suppress_neighbors(xy, scores, radii).tolist() == kept
