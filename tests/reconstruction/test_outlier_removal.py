from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.reconstruction.outlier_removal import (
    disparity_space,
    mean_neighbour_distances,
    statistical_inliers,
)


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
    np.testing.assert_allclose(mean_neighbour_distances(points, 7), gaps[:, 1:8].mean(1), rtol=1e-3)
    np.testing.assert_allclose(
        mean_neighbour_distances(points[:5], 50),
        np.linalg.norm(points[:5, None] - points[:5], axis=2).sum(1) / 4,
        rtol=1e-3,
    )


def test_distances_are_those_of_scipy_on_a_surface() -> None:
    spatial = pytest.importorskip("scipy.spatial")
    points, _ = street()
    space = disparity_space(points, 500)
    expected, _ = spatial.cKDTree(space).query(space, k=17)
    np.testing.assert_allclose(
        mean_neighbour_distances(space, 16), expected[:, 1:].mean(1), rtol=1e-3
    )


def test_points_astray_are_found_near_and_far_in_disparity_space_only() -> None:
    points, astray = street()
    kept = statistical_inliers(disparity_space(points, 500))
    assert (~kept[astray]).mean() > 0.9
    assert kept[~astray].mean() > 0.97
    # In space the spacing of the far points hides all that is astray among the near.
    assert (~statistical_inliers(points)[astray]).mean() < 0.5


def test_pixels_and_disparities_are_the_space() -> None:
    points = np.array([[1.0, -2, 4]])
    np.testing.assert_allclose(disparity_space(points, 100, 0.5), [[25, -50, 2 * 12.5]])
    np.testing.assert_allclose(disparity_space(points * 10, 100, 5), [[25, -50, 25]])


def test_a_smaller_factor_removes_more() -> None:
    points, _ = street()
    counts = [statistical_inliers(points, 8, factor).sum() for factor in (0, 0.5, 1, 2, 4)]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_the_scale_and_the_place_do_not_matter() -> None:
    points, _ = street()
    kept = statistical_inliers(points)
    for other in (points * 1000, points + [1e4, 0, 0], points[:, ::-1]):
        assert (statistical_inliers(other) == kept).mean() > 0.999


def test_few_equal_and_infinite_points_raise_nothing() -> None:
    for count in (0, 1, 2, 3):
        assert statistical_inliers(np.arange(3.0 * count).reshape(-1, 3)).all()
    assert statistical_inliers(np.ones((5000, 3))).all()
    points = np.random.default_rng(0).normal(size=(100, 3))
    points[3], points[7, 1] = np.nan, np.inf
    assert not statistical_inliers(points)[[3, 7]].any()
    assert statistical_inliers(points).sum() > 80


def test_what_is_wrong_is_said() -> None:
    for options in ({"neighbours": 0}, {"factor": -1}, {"factor": float("nan")}):
        with pytest.raises(OptionError):
            statistical_inliers(np.ones((9, 3)), **options)
