from __future__ import annotations

import numpy as np
import pytest

from deepdetect.features.selection import suppress_neighbors


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
