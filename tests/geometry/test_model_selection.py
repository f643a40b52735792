from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import GeometryOptions, estimate_geometry
from deepdetect.geometry.model_selection import select_model

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
    options = GeometryOptions(model="auto", inlier_threshold=1.5)
    found = estimate_geometry(*matches(depth), options)
    assert found.model == kind
    assert found.inliers.sum() > 300


def test_auto_of_too_few_matches_is_nothing() -> None:
    found = estimate_geometry(np.zeros((2, 2)), np.zeros((2, 2)), GeometryOptions(model="auto"))
    assert found.matrix is None
    assert not found.inliers.any()


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_what_a_plane_explains_has_no_depth(explained: list[bool]) -> None:
    inliers = np.array(explained)
    assert select_model(inliers, inliers) == "homography"
    assert select_model(np.ones_like(inliers), inliers) == "homography"


def test_depth_needs_a_share_of_the_rest_and_of_all() -> None:
    index = np.arange(1000)
    assert select_model(index < 800, index < 950) == "fundamental"
    assert select_model(index < 800, index < 880) == "homography"  # less than half of the rest
    assert select_model(index < 950, index < 1000) == "homography"  # next to nothing of all
