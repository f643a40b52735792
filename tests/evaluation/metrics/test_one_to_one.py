from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.one_to_one import one_to_one_repeatability
from deepdetect.geometry import transform_points

SIZES = ((64, 48), (64, 48))
IDENTITY = np.eye(3)


def scattered(count: int, seed: int = 0) -> np.ndarray:
    """Distinct points at least 4 px apart."""
    grid = np.stack(np.meshgrid(np.arange(4, 60, 4), np.arange(4, 44, 4)), -1).reshape(-1, 2)
    return np.random.default_rng(seed).permutation(grid)[:count].astype(float)


def test_the_same_points_are_all_repeated() -> None:
    points = scattered(40)
    for entry in one_to_one_repeatability(points, points, IDENTITY, SIZES):
        assert (entry.value, entry.localisation, entry.fewest) == (1, 0, 40)
        assert entry.corrected == 1


def test_one_point_off_by_one_and_a_half_pixels() -> None:
    points = scattered(4)
    moved = points + np.array([[0, 0], [0, 1.5], [0, 0], [0, 0]])
    at = {e.radius: e for e in one_to_one_repeatability(points, moved, IDENTITY, SIZES)}
    assert at[1.0].value == 0.75
    assert at[1.0].localisation == 0
    assert at[2.0].value == 1
    assert at[2.0].localisation == pytest.approx(1.5 / 4)


def test_the_radius_belongs_to_it() -> None:
    points = scattered(4)
    (entry,) = one_to_one_repeatability(points, points + [1, 0], IDENTITY, SIZES, radii=(1.0,))
    assert entry.value == 1


def test_points_outside_the_overlap_do_not_count() -> None:
    points = scattered(30)
    shift = np.array([[1.0, 0, 1000], [0, 1, 0], [0, 0, 1]])
    for entry in one_to_one_repeatability(points, points, shift, SIZES):
        assert (entry.value, entry.fewest, entry.chance) == (0, 0, 0)
        assert math.isnan(entry.localisation)
    half = np.array([[1.0, 0, 32], [0, 1, 0], [0, 0, 1]])
    seen = points[points[:, 0] < 31.5]
    moved = np.concatenate([seen + [32, 0], [[3, 3], [10, 40]]])  # the last two: left half of B
    (entry,) = one_to_one_repeatability(points, moved, half, SIZES, radii=(1.0,))
    assert (entry.value, entry.fewest) == (1, len(seen))


def test_a_partner_is_not_shared() -> None:
    crowd = np.array([[10.0, 10], [10.4, 10], [10, 10.4], [30, 30]])
    single = np.array([[10.0, 10], [30, 30], [50, 5], [50, 40]])
    (entry,) = one_to_one_repeatability(crowd, single, IDENTITY, SIZES, radii=(1.0,))
    assert entry.repeated == 2
    assert entry.value == 0.5


def test_no_points_are_no_error() -> None:
    none = np.empty((0, 2))
    for entry in one_to_one_repeatability(none, scattered(5), IDENTITY, SIZES):
        assert (entry.value, entry.repeated, entry.chance) == (0, 0, 0)


def test_chance_is_what_random_points_reach() -> None:
    generator = np.random.default_rng(5)
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    first, second = (generator.permutation(everything)[:1500].astype(float) for _ in range(2))
    for entry in one_to_one_repeatability(first, second, IDENTITY, SIZES):
        assert entry.value == pytest.approx(entry.chance, abs=0.03)
        assert abs(entry.corrected) < 0.15
    (sparse,) = one_to_one_repeatability(first[:20], second[:20], IDENTITY, SIZES, radii=(1.0,))
    # Twenty points have five pixels each within 1 px: 20 * 5 / 3072, a little fewer at borders.
    assert sparse.chance == pytest.approx(20 * 5 / 3072, rel=0.25)


def test_a_full_grid_is_chance_by_definition() -> None:
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    (entry,) = one_to_one_repeatability(everything, everything, IDENTITY, SIZES, radii=(1.0,))
    assert (entry.value, entry.chance, entry.corrected) == (1, 1, 0)


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
    for entry in one_to_one_repeatability(points, moved, homography, SIZES):
        assert entry.repeated == entry.fewest
        assert entry.repeated == 0 or entry.localisation == pytest.approx(0, abs=1e-6)
        assert 0 <= entry.chance <= 1


def test_chance_of_points_between_pixels_is_that_of_such_points() -> None:
    generator = np.random.default_rng(5)
    size = (64, 48)
    points = [generator.uniform(-0.5, np.array(size) - 0.5, (20, 2)) for _ in range(2)]
    entry = one_to_one_repeatability(*points, np.eye(3), (size, size), (1.0,))[0]
    assert entry.chance == pytest.approx(20 * np.pi / 3072, rel=0.2)
