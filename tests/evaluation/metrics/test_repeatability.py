from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics import published_repeatability, repeated
from deepdetect.geometry.residuals import transform_points

SHIFT = np.array([[1, 0, 2.0], [0, 1, -1.0], [0, 0, 1]])


def brute(points0, points1, homography, radius) -> np.ndarray:
    mapped = transform_points(points0, homography)
    if not len(points1):
        return np.zeros(len(mapped), bool)
    return (np.linalg.norm(mapped[:, None] - np.asarray(points1)[None], axis=2) < radius).any(1)


def test_the_same_points_are_all_repeated() -> None:
    points = np.random.default_rng(0).uniform(0, 50, (200, 2))
    assert published_repeatability(points, points, np.eye(3)) == 1
    assert published_repeatability(points, transform_points(points, SHIFT), SHIFT) == 1


def test_one_of_four_off_by_a_pixel_and_a_half() -> None:
    points = np.array([[10, 10], [20, 10], [10, 20], [20, 20.0]])
    moved = points + [[0, 0], [0, 0], [0, 0], [1.5, 0]]
    assert published_repeatability(points, moved, np.eye(3)) == 0.75
    assert published_repeatability(points, moved, np.eye(3), radius=2) == 1


def test_near_is_strictly_closer() -> None:
    assert not repeated([[0, 0]], [[1, 0]], np.eye(3)).any()
    assert repeated([[0, 0]], [[np.nextafter(1, 0), 0]], np.eye(3)).all()


def test_the_smaller_count_divides_and_the_result_is_clipped() -> None:
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    few = grid[2::5]
    assert published_repeatability(few, grid, np.eye(3)) == 1
    # Half a pixel off, up to two of the many land near each of the few.
    half = np.array([[1, 0, 0.5], [0, 1, 0], [0, 0, 1]])
    assert np.count_nonzero(repeated(grid, few, half)) > len(few)
    assert published_repeatability(grid, few, half) == 1


def test_points_outside_the_overlap_stay_in_the_denominator() -> None:
    points = np.array([[0, 0], [1000, 1000.0]])
    assert published_repeatability(points, np.array([[0, 0], [5, 5.0]]), np.eye(3)) == 0.5


@pytest.mark.parametrize(("first", "second"), [(0, 5), (5, 0), (0, 0)])
def test_no_points_are_never_repeated(first: int, second: int) -> None:
    assert published_repeatability(np.zeros((first, 2)), np.zeros((second, 2)), np.eye(3)) == 0


@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    radius=st.sampled_from([0.5, 1.0, 2.0, 3.7]),
    whole=st.booleans(),
)
def test_the_grid_finds_what_a_search_through_all_finds(
    seed: int, counts: tuple[int, int], radius: float, whole: bool
) -> None:
    generator = np.random.default_rng(seed)
    points0, points1 = (generator.uniform(-5, 25, (count, 2)) for count in counts)
    if whole:
        points0, points1 = points0.round(), points1.round()
    homography = np.eye(3)
    homography[:2] += generator.normal(0, 1, (2, 3)) * [0.1, 0.1, 2]
    homography[2, :2] += generator.normal(0, 0.002, 2)
    np.testing.assert_array_equal(
        repeated(points0, points1, homography, radius),
        brute(points0, points1, homography, radius),
    )
