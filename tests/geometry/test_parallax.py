from __future__ import annotations

import numpy as np
import pytest

from deepdetect import estimate_geometry
from deepdetect.geometry import GeometryOptions
from deepdetect.geometry.estimation import measure_parallax

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
