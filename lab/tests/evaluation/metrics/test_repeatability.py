from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.geometry import transform_points
from deepdetect_lab.evaluation.metrics.repeatability import (
    foreground_fraction,
    mutual_nn_repeatability,
    repeatability_paper,
)


def test_one_of_four_off_by_a_pixel_and_a_half() -> None:
    points = np.array([[10, 10], [20, 10], [10, 20], [20, 20.0]])
    moved = points + [[0, 0], [0, 0], [0, 0], [1.5, 0]]
    assert repeatability_paper(points, moved, np.eye(3)) == 0.75
    assert repeatability_paper(points, moved, np.eye(3), radius_px=2) == 1


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
    expected = 0.0
    if min(counts):
        mapped = transform_points(points0, homography)
        near = np.linalg.norm(mapped[:, None] - points1[None], axis=2) < radius
        expected = min(np.count_nonzero(near.any(axis=1)) / min(counts), 1)
    assert repeatability_paper(points0, points1, homography, radius) == expected


SIZES = ((64, 48), (64, 48))
IDENTITY = np.eye(3)


def scattered(count: int, seed: int = 0) -> np.ndarray:
    """Distinct points at least 4 px apart."""
    grid = np.stack(np.meshgrid(np.arange(4, 60, 4), np.arange(4, 44, 4)), -1).reshape(-1, 2)
    return np.random.default_rng(seed).permutation(grid)[:count].astype(float)


def by_radius(*arguments, radii_px=(1.0, 2.0, 3.0)):
    """Return value, chance and localization at each radius."""
    found = mutual_nn_repeatability(*arguments, SIZES, radii_px)
    return dict(zip(radii_px, found, strict=True))


def test_one_point_off_by_one_and_a_half_pixels() -> None:
    points = scattered(4)
    assert {found[::2] for found in by_radius(points, points, IDENTITY).values()} == {(1, 0)}
    moved = points + np.array([[0, 0], [0, 1.5], [0, 0], [0, 0]])
    at = by_radius(points, moved, IDENTITY)
    assert at[1.0][::2] == (0.75, 0)
    assert at[2.0][::2] == (1, pytest.approx(1.5 / 4))
    assert by_radius(points, points + [1, 0], IDENTITY)[1.0][0] == 1, "the radius belongs to it"


def test_points_outside_the_overlap_do_not_count() -> None:
    points = scattered(30)
    shift = np.array([[1.0, 0, 1000], [0, 1, 0], [0, 0, 1]])
    for nothing in (
        by_radius(points, points, shift)[1.0],
        by_radius(np.empty((0, 2)), points, IDENTITY)[1.0],
    ):
        assert nothing[:2] == (0, 0)
        assert math.isnan(nothing[2])
    half = np.array([[1.0, 0, 32], [0, 1, 0], [0, 0, 1]])
    seen = points[points[:, 0] < 31.5]
    moved = np.concatenate([seen + [32, 0], [[3, 3], [10, 40]]])  # the last two: left half of B
    assert by_radius(points, moved, half)[1.0][0] == 1


def test_a_partner_is_not_shared() -> None:
    crowd = np.array([[10.0, 10], [10.4, 10], [10, 10.4], [30, 30]])
    single = np.array([[10.0, 10], [30, 30], [50, 5], [50, 40]])
    assert by_radius(crowd, single, IDENTITY)[1.0][0] == 0.5


def test_chance_is_what_random_points_reach() -> None:
    generator = np.random.default_rng(5)
    everything = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    assert by_radius(everything, everything, IDENTITY)[1.0][:2] == (1, 1)
    first, second = (generator.permutation(everything)[:1500].astype(float) for _ in range(2))
    for value, chance, _ in by_radius(first, second, IDENTITY).values():
        assert value == pytest.approx(chance, abs=0.03)
    # Twenty points have five pixels each within 1 px: 20 * 5 / 3072, a little fewer at borders.
    _, chance, _ = by_radius(first[:20], second[:20], IDENTITY)[1.0]
    assert chance == pytest.approx(20 * 5 / 3072, rel=0.25)
    # Points between pixels are compared with such ones.
    between = [generator.uniform(-0.5, np.array(SIZES[0]) - 0.5, (20, 2)) for _ in range(2)]
    assert by_radius(*between, IDENTITY)[1.0][1] == pytest.approx(20 * np.pi / 3072, rel=0.2)


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
    for value, chance, localization in by_radius(points, moved, homography).values():
        assert value in (0, 1)
        assert value == 0 or localization == pytest.approx(0, abs=1e-6)
        assert 0 <= chance <= 1


def test_foreground_fraction() -> None:
    foreground = np.zeros((4, 6), bool)
    foreground[:, 3:] = True
    points = np.array([[0, 0], [3, 0], [5, 3], [2.4, 1], [2.6, 1]])
    assert foreground_fraction(points, foreground) == 0.6
    assert math.isnan(foreground_fraction(np.empty((0, 2)), foreground))
