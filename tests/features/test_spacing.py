from __future__ import annotations

import numpy as np
import pytest

from deepdetect.features.spacing import descending_order, grid_subsample, suppress_neighbors


def test_grid_subsample_takes_one_of_each_cell() -> None:
    points = np.random.default_rng(0).uniform(0, 100, (5000, 2))
    rows = grid_subsample(points, 10)
    assert len(rows) == 100
    assert len(np.unique(points[rows] // 10, axis=0)) == 100
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, grid_subsample(points, 10))
    assert (rows != grid_subsample(points, 10, seed=1)).any()


@pytest.mark.parametrize("seed", range(3))
def test_of_two_radii_the_smaller_one_counts(seed: int) -> None:
    generator = np.random.default_rng(seed)
    xy = generator.uniform(-3, 30, (300, 2))
    scores, radii = generator.integers(20, size=300), generator.uniform(0.5, 6, 300)
    kept: list[int] = []
    for row in np.argsort(-scores, kind="stable"):
        gaps = np.linalg.norm(xy[kept] - xy[row], axis=1)
        if (gaps >= np.minimum(radii[kept], radii[row])).all():
            kept.append(int(row))
    assert suppress_neighbors(xy, scores, radii).tolist() == kept
    assert suppress_neighbors(xy, scores, radii, 7).tolist() == kept[:7]


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
def test_descending_order_is_that_of_a_stable_sort(dtype: type) -> None:
    values = np.random.default_rng(0).integers(-9, 9, 200).astype(dtype) / 2
    values = np.concatenate([values, [-0.0, 0.0]]).astype(dtype)
    expected = np.argsort(-values, kind="stable")
    np.testing.assert_array_equal(descending_order(values), expected)
