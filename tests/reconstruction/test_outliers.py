from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import OptionError
from deepdetect.reconstruction.outliers import (
    PointFilterOptions,
    disparity_space,
    mean_neighbor_distances,
    sor_inliers,
)
from deepdetect.reconstruction.pipeline import SOR_WINDOW_PX, sor_inliers_on_grid


def street() -> tuple[np.ndarray, np.ndarray]:
    """A road, a facade and a pole from 5 to 125 baselines away, and which points are astray."""
    generator = np.random.default_rng(0)
    row, column = (part.ravel() for part in np.indices((160, 213)) * 3)
    disparity = np.where(row > 250, (row - 240) * 0.4, 4.0) + (column > 500) * 20.0
    measured = disparity + generator.normal(0, 0.2, len(row))
    astray = generator.random(len(row)) < 0.03
    measured[astray] = generator.uniform(3, 120, astray.sum())
    depth = 500 / measured
    points = np.column_stack([(column - 320) / 500 * depth, (row - 240) / 500 * depth, depth])
    return points, astray & (np.abs(measured - disparity) > 15)


def test_distances_are_those_of_brute_force() -> None:
    points = np.random.default_rng(0).normal(size=(400, 3)) * [1, 5, 0.1] + 1000
    gaps = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)
    np.testing.assert_allclose(mean_neighbor_distances(points, 7), gaps[:, 1:8].mean(1), rtol=1e-3)
    np.testing.assert_allclose(
        mean_neighbor_distances(points[:5], 50),
        np.linalg.norm(points[:5, None] - points[:5], axis=2).sum(1) / 4,
        rtol=1e-3,
    )


def test_points_astray_are_found_near_and_far_in_disparity_space_only() -> None:
    points, astray = street()
    kept = sor_inliers(disparity_space(points, 500))
    assert (~kept[astray]).mean() > 0.9
    assert kept[~astray].mean() > 0.97
    # In space the spacing of the far points hides all that is astray among the near.
    assert (~sor_inliers(points)[astray]).mean() < 0.5


def test_few_and_equal_points_raise_nothing() -> None:
    for count in (0, 1, 2, 3):
        assert sor_inliers(np.arange(3.0 * count).reshape(-1, 3)).all()
    assert sor_inliers(np.ones((5000, 3))).all()


def test_what_is_wrong_is_said() -> None:
    for options in (
        {"min_parallax_px": -1},
        {"sor_neighbors": -1},
        {"sor_std_ratio": float("nan")},
    ):
        with pytest.raises(OptionError):
            PointFilterOptions(**options)


def scattered(seed: int, share: float, size: tuple[int, int]) -> np.ndarray:
    """Return random whole pixels (x, y) of an image."""
    width, height = size
    rows, columns = np.nonzero(np.random.default_rng(seed).random((height, width)) < share)
    return np.column_stack([columns, rows])


def by_brute_force(
    pixels: np.ndarray, disparity: np.ndarray, window: int, factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return which are inliers, and how far each is from the bound."""
    near = (np.abs(pixels[:, None] - pixels) <= window // 2).all(2)
    np.fill_diagonal(near, False)
    some = near.any(1)
    differences = np.where(near, (disparity[:, None] - disparity) ** 2, 0).sum(1)
    distances = np.sqrt(differences / np.maximum(near.sum(1), 1))
    bound = distances[some].mean() + factor * distances[some].std() if some.any() else 0.0
    alone = ~some & (some.mean() > 0.5)
    return (distances <= bound) & ~alone, np.abs(distances - bound)


@given(
    seed=st.integers(0, 2**31),
    share=st.floats(0.02, 1),
    factor=st.sampled_from([0.5, 1.0, 2.0]),
    middle=st.sampled_from([0.0, 40.0, -300.0]),
)
def test_on_a_grid_it_is_what_brute_force_finds(
    seed: int, share: float, factor: float, middle: float
) -> None:
    size = (31, 17)
    pixels = scattered(seed, share, size)
    generator = np.random.default_rng(seed)
    disparity = (middle + generator.normal(0, 1, len(pixels))).astype(np.float32)
    wild = generator.random(len(pixels)) < 0.05
    disparity[wild] += generator.uniform(-20, 20, wild.sum())
    kept = sor_inliers_on_grid(pixels, disparity, size, PointFilterOptions(sor_std_ratio=factor))
    expected, gap = by_brute_force(pixels, disparity.astype(float), SOR_WINDOW_PX, factor)
    assert kept.shape == (len(pixels),)
    near = gap > 1e-4
    some = (np.abs(pixels[:, None] - pixels) <= SOR_WINDOW_PX // 2).all(2).sum(1) > 1
    if some.any():
        np.testing.assert_array_equal(kept[near | ~some], expected[near | ~some])
    else:
        assert kept.all()


def test_on_a_grid_one_alone_goes_where_most_have_others() -> None:
    block = np.stack(np.meshgrid(np.arange(12), np.arange(12)), -1).reshape(-1, 2)
    pixels = np.vstack([block, [[50, 50]]])
    kept = sor_inliers_on_grid(pixels, np.full(145, 9.0), (60, 60))
    assert np.flatnonzero(~kept).tolist() == [144]
    # Where all stand alone none is worse than the others.
    sparse = np.stack(np.meshgrid(np.arange(0, 60, 20), np.arange(0, 60, 20)), -1).reshape(-1, 2)
    assert sor_inliers_on_grid(sparse, np.arange(9.0), (60, 60)).all()
    assert sor_inliers_on_grid(np.empty((0, 2)), np.empty(0), (60, 60)).shape == (0,)
    assert sor_inliers_on_grid(block, np.full(144, 9.0), (60, 60)).all()
