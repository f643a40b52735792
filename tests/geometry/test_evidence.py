from __future__ import annotations

from math import comb, log10, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.geometry import (
    GeometryOptions,
    epipolar_errors,
    estimate_geometry,
    transfer_errors,
)
from deepdetect.geometry.estimation import (
    MAX_LOG10_NFA,
    MINIMAL_SAMPLE_SIZE,
    log10_nfa,
    measure_parallax,
)

SIZE = (640, 480)
KINDS = sorted(MINIMAL_SAMPLE_SIZE)


def near(inliers: int, count: int) -> np.ndarray:
    return np.arange(count) < inliers


def chance(kind: str, threshold: float, size: tuple[int, int]) -> float:
    """Share of the image that is near to a point or to a line, as far as it goes."""
    area = size[0] * size[1]
    reached = pi * threshold**2 if kind == "homography" else 2 * threshold * np.hypot(*size)
    return min(reached / area, 1.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("inliers", "count"), [(8, 9), (12, 100), (30, 30), (200, 1000)])
def test_equals_the_formula_of_moisan_and_stival(kind: str, inliers: int, count: int) -> None:
    """(n - d) (n over k) (k over d) p^(k - d), in whole numbers of any length."""
    drawn = MINIMAL_SAMPLE_SIZE[kind]
    tests = (count - drawn) * comb(count, inliers) * comb(inliers, drawn)
    expected = log10(tests) + (inliers - drawn) * log10(chance(kind, 2, SIZE))
    found = log10_nfa(near(inliers, count), kind, 2, SIZE)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)


@given(
    kind=st.sampled_from(KINDS),
    count=st.integers(5, 3000),
    threshold=st.floats(0.5, 5),
    size=st.tuples(st.integers(50, 1200), st.integers(50, 1200)),
)
def test_as_many_inliers_as_chance_gives_are_no_evidence(
    kind: str, count: int, threshold: float, size: tuple[int, int]
) -> None:
    inliers = int(count * chance(kind, threshold, size))
    assert log10_nfa(near(inliers, count), kind, threshold, size) > 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [0, 1, 4, 7])
def test_as_few_as_a_model_is_drawn_from_are_never_evidence(kind: str, count: int) -> None:
    inliers = min(count, MINIMAL_SAMPLE_SIZE[kind])
    assert log10_nfa(near(inliers, count), kind, 3, SIZE) == float("inf")
    assert log10_nfa(near(inliers, 500), kind, 3, SIZE) == float("inf")


@pytest.mark.parametrize("kind", ["homography", "fundamental"])
def test_random_matches_are_not_trusted(kind: str) -> None:
    """The best model of random matches, as it is searched for in earnest."""
    threshold = {"homography": 3.0, "fundamental": 1.5}[kind]
    measure = {"homography": transfer_errors, "fundamental": epipolar_errors}[kind]
    for seed in range(15):
        points0, points1 = np.random.default_rng(seed).uniform(0, 200, (2, 60, 2))
        options = GeometryOptions(inlier_threshold=threshold, iterations=2000)
        matrix = estimate_geometry(points0, points1, kind, options=options).matrix
        if matrix is not None:
            inliers = measure(points0, points1, matrix) < threshold
            assert log10_nfa(inliers, kind, threshold, (200, 200)) > MAX_LOG10_NFA


CAMERA = np.array([[600, 0, 320], [0, 600, 240], [0, 0, 1]], float)
PLANE = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 30.0], [1e-4, 5e-5, 1.0]])


def matches(depth: float, outliers: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Matches of a scene between 5 - depth and 5 + depth, seen from two places."""
    generator = np.random.default_rng(0)
    points0 = generator.uniform((0, 0), (640, 480), (500, 2))
    distance = generator.uniform(5 - depth, 5 + depth, 500)
    points1 = points0 - np.column_stack([300 / distance, 20 / distance])
    wrong = generator.random(500) < outliers
    points1[wrong] = generator.uniform((0, 0), (640, 480), (wrong.sum(), 2))
    return points0, points1 + generator.normal(0, 0.3, points1.shape)


@pytest.mark.parametrize(("depth", "kind"), [(0.0, "homography"), (3.0, "fundamental")])
def test_auto_takes_what_fits(depth: float, kind: str) -> None:
    options = GeometryOptions(inlier_threshold=1.5)
    found = estimate_geometry(*matches(depth), "auto", options=options)
    assert found.model == kind
    assert found.inliers.sum() > 300


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_depth_is_seen_among_wrong_matches(outliers: float) -> None:
    points0, points1 = matches(3.0, outliers)
    wall = np.array([[1, 0, -60], [0, 1, -4], [0, 0, 1.0]])  # what lies at a distance of 5
    found = measure_parallax(points0, points1, wall)
    assert found.exceeds(0)
    right = (1 - outliers) * (found.on_plane + found.off_plane)
    assert found.agreeing > 0.85 * (right - found.on_plane)
    assert found.shows_depth == (outliers < 0.6), "too many wrong ones: the images decide"


@pytest.mark.parametrize("outliers", [0.0, 0.3, 0.6])
def test_wrong_matches_on_a_plane_are_no_depth(outliers: float) -> None:
    points0, points1 = matches(0.0, outliers)
    wall = np.array([[1, 0, -60], [0, 1, -4], [0, 0, 1.0]])
    found = measure_parallax(points0, points1, wall)
    assert not found.exceeds(0)
    assert not found.shows_depth


def test_a_pattern_that_is_matched_one_period_off_is_no_depth() -> None:
    points = np.random.default_rng(0).uniform((0, 0), (640, 480), (540, 2))
    moved = points + np.where(np.arange(540) < 500, 0, 25)[:, None] * (1, 0)
    found = measure_parallax(points, moved, np.eye(3))
    assert (found.on_plane, found.off_plane, found.agreeing) == (500, 40, 40)
    assert found.exceeds(0)
    assert not found.shows_depth
    assert found.exceeds(0.05)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_matches_show_nothing(count: int) -> None:
    points0, points1 = (points[:count] for points in matches(3.0))
    found = measure_parallax(points0, points1, np.eye(3))
    assert not found.exceeds(0)
