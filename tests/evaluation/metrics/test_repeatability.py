from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.repeatability import (
    mutual_nn_repeatability,
    repeatability_paper,
    repeated,
)
from deepdetect.geometry import transform_points

SHIFT = np.array([[1, 0, 2.0], [0, 1, -1.0], [0, 0, 1]])


def brute(points0, points1, homography, radius) -> np.ndarray:
    mapped = transform_points(points0, homography)
    if not len(points1):
        return np.zeros(len(mapped), bool)
    return (np.linalg.norm(mapped[:, None] - np.asarray(points1)[None], axis=2) < radius).any(1)


def test_of_the_same_points_all_are_near() -> None:
    points = np.random.default_rng(0).uniform(0, 50, (200, 2))
    assert repeatability_paper(points, points, np.eye(3)) == 1
    assert repeatability_paper(points, transform_points(points, SHIFT), SHIFT) == 1


def test_one_of_four_off_by_a_pixel_and_a_half() -> None:
    points = np.array([[10, 10], [20, 10], [10, 20], [20, 20.0]])
    moved = points + [[0, 0], [0, 0], [0, 0], [1.5, 0]]
    assert repeatability_paper(points, moved, np.eye(3)) == 0.75
    assert repeatability_paper(points, moved, np.eye(3), radius_px=2) == 1


def test_near_is_strictly_closer() -> None:
    assert not repeated([[0, 0]], [[1, 0]], np.eye(3)).any()
    assert repeated([[0, 0]], [[np.nextafter(1, 0), 0]], np.eye(3)).all()


def test_the_smaller_count_divides_and_the_result_is_clipped() -> None:
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    few = grid[2::5]
    assert repeatability_paper(few, grid, np.eye(3)) == 1
    # Half a pixel off, up to two of the many land near each of the few.
    half = np.array([[1, 0, 0.5], [0, 1, 0], [0, 0, 1]])
    assert np.count_nonzero(repeated(grid, few, half)) > len(few)
    assert repeatability_paper(grid, few, half) == 1


def test_points_outside_the_overlap_stay_in_the_denominator() -> None:
    points = np.array([[0, 0], [1000, 1000.0]])
    assert repeatability_paper(points, np.array([[0, 0], [5, 5.0]]), np.eye(3)) == 0.5


@pytest.mark.parametrize(("first", "second"), [(0, 5), (5, 0), (0, 0)])
def test_no_points_are_never_repeated(first: int, second: int) -> None:
    assert repeatability_paper(np.zeros((first, 2)), np.zeros((second, 2)), np.eye(3)) == 0


@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.tuples(st.integers(0, 60), st.integers(0, 60)),
    radius=st.sampled_from([0.5, 1.0, 2.0, 3.7]),
    whole=st.booleans(),
)
def test_the_tree_finds_what_a_search_through_all_finds(
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


SIZES = ((64, 48), (64, 48))
IDENTITY = np.eye(3)


def scattered(count: int, seed: int = 0) -> np.ndarray:
    """Distinct points at least 4 px apart."""
    grid = np.stack(np.meshgrid(np.arange(4, 60, 4), np.arange(4, 44, 4)), -1).reshape(-1, 2)
    return np.random.default_rng(seed).permutation(grid)[:count].astype(float)


def test_the_same_points_are_all_repeated() -> None:
    points = scattered(40)
    for entry in mutual_nn_repeatability(points, points, IDENTITY, SIZES):
        assert (entry.value, entry.localization_px, entry.fewest) == (1, 0, 40)


def test_one_point_off_by_one_and_a_half_pixels() -> None:
    points = scattered(4)
    moved = points + np.array([[0, 0], [0, 1.5], [0, 0], [0, 0]])
    at = {e.radius_px: e for e in mutual_nn_repeatability(points, moved, IDENTITY, SIZES)}
    assert at[1.0].value == 0.75
    assert at[1.0].localization_px == 0
    assert at[2.0].value == 1
    assert at[2.0].localization_px == pytest.approx(1.5 / 4)


def test_the_radius_belongs_to_it() -> None:
    points = scattered(4)
    (entry,) = mutual_nn_repeatability(points, points + [1, 0], IDENTITY, SIZES, radii_px=(1.0,))
    assert entry.value == 1


def test_points_outside_the_overlap_do_not_count() -> None:
    points = scattered(30)
    shift = np.array([[1.0, 0, 1000], [0, 1, 0], [0, 0, 1]])
    for entry in mutual_nn_repeatability(points, points, shift, SIZES):
        assert (entry.value, entry.fewest, entry.chance) == (0, 0, 0)
        assert math.isnan(entry.localization_px)
    half = np.array([[1.0, 0, 32], [0, 1, 0], [0, 0, 1]])
    seen = points[points[:, 0] < 31.5]
    moved = np.concatenate([seen + [32, 0], [[3, 3], [10, 40]]])  # the last two: left half of B
    (entry,) = mutual_nn_repeatability(points, moved, half, SIZES, radii_px=(1.0,))
    assert (entry.value, entry.fewest) == (1, len(seen))


def test_a_partner_is_not_shared() -> None:
    crowd = np.array([[10.0, 10], [10.4, 10], [10, 10.4], [30, 30]])
    single = np.array([[10.0, 10], [30, 30], [50, 5], [50, 40]])
    (entry,) = mutual_nn_repeatability(crowd, single, IDENTITY, SIZES, radii_px=(1.0,))
    assert entry.repeated == 2
    assert entry.value == 0.5


def test_no_points_are_no_error() -> None:
    none = np.empty((0, 2))
    for entry in mutual_nn_repeatability(none, scattered(5), IDENTITY, SIZES):
        assert (entry.value, entry.repeated, entry.chance) == (0, 0, 0)


def test_chance_is_what_random_points_reach() -> None:
    generator = np.random.default_rng(5)
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    first, second = (generator.permutation(everything)[:1500].astype(float) for _ in range(2))
    for entry in mutual_nn_repeatability(first, second, IDENTITY, SIZES):
        assert entry.value == pytest.approx(entry.chance, abs=0.03)
        assert entry.value == pytest.approx(entry.chance, abs=0.1)
    (sparse,) = mutual_nn_repeatability(first[:20], second[:20], IDENTITY, SIZES, radii_px=(1.0,))
    # Twenty points have five pixels each within 1 px: 20 * 5 / 3072, a little fewer at borders.
    assert sparse.chance == pytest.approx(20 * 5 / 3072, rel=0.25)


def test_a_full_grid_is_chance_by_definition() -> None:
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    (entry,) = mutual_nn_repeatability(everything, everything, IDENTITY, SIZES, radii_px=(1.0,))
    assert (entry.value, entry.chance) == (1, 1)


@given(
    tilt=st.floats(-1e-3, 1e-3),
    angle=st.floats(-0.5, 0.5),
    scale=st.floats(0.8, 1.5),
    shift=st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
)
def test_points_moved_by_the_homography_are_repeated(
    tilt: float, angle: float, scale: float, shift: tuple[float, float]
) -> None:
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    homography = np.array([[c, -s, shift[0]], [s, c, shift[1]], [tilt, 0, 1]])
    points = scattered(60)
    moved = transform_points(points, homography)
    for entry in mutual_nn_repeatability(points, moved, homography, SIZES):
        assert entry.repeated == entry.fewest
        assert entry.repeated == 0 or entry.localization_px == pytest.approx(0, abs=1e-6)
        assert 0 <= entry.chance <= 1


def test_chance_of_points_between_pixels_is_that_of_such_points() -> None:
    generator = np.random.default_rng(5)
    size = (64, 48)
    points = [generator.uniform(-0.5, np.array(size) - 0.5, (20, 2)) for _ in range(2)]
    entry = mutual_nn_repeatability(*points, np.eye(3), (size, size), (1.0,))[0]
    assert entry.chance == pytest.approx(20 * np.pi / 3072, rel=0.2)
