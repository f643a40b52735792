"""The page's geometry of matches, run by node: what is evidence of one, and what is none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

SIZE = (640, 480)
DIAGONAL = 800.0
HOMOGRAPHY = np.array([[0.9, -0.2, 80], [0.15, 0.95, -20], [1e-4, -5e-5, 1]])
MODELS = ("none", "homography", "fundamental")


def estimate(run_node: Any, points0: np.ndarray, points1: np.ndarray) -> tuple[str, np.ndarray]:
    """Return the page's model, and which matches agree with it."""
    imports = 'import { estimateGeometry } from "@/geometry.js";\n'
    script = """
const points = new Float32Array(bytes);
const half = points.length / 2;
const sizes = [[width, height], [width, height]];
const { model, inliers } = estimateGeometry(points.subarray(0, half), points.subarray(half), sizes);
const numbers = [values.models.indexOf(model), ...inliers];
writeFileSync(made, new Uint8Array(Float64Array.from(numbers).buffer));
"""
    given = np.stack([points0, points1]).astype(np.float32)
    width, height = SIZE
    found = run_node(imports, script, given, width=width, height=height, models=MODELS)
    return MODELS[int(found[0])], found[1:] == 1


def moved(points: np.ndarray) -> np.ndarray:
    """Return where the homography takes points."""
    found = np.column_stack([points, np.ones(len(points))]) @ HOMOGRAPHY.T
    return found[:, :2] / found[:, 2:]


def anywhere(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, SIZE, (count, 2))


def edge(count: int, length: float) -> np.ndarray:
    """Return places along a line of this length."""
    return np.array([300.0, 200.0]) + np.linspace(0, length, count)[:, None] * (0.8, 0.6)


def spread(count: int) -> np.ndarray:
    """Return places that are far from each other."""
    places = np.stack(np.meshgrid(np.linspace(150, 500, 5), np.linspace(120, 400, 4)), -1)
    return np.random.default_rng(0).permutation(places.reshape(-1, 2))[:count]


SHORT_EDGE = edge(40, 0.02 * DIAGONAL)
"""One place, or two where the second picture is larger."""


@pytest.mark.parametrize(
    ("places", "wrong", "expected"),
    [
        pytest.param(spread(20), 60, "homography", id="20 places"),
        pytest.param(spread(9), 10, "homography", id="9 places"),
        pytest.param(spread(8), 0, "none", id="8 places"),
        pytest.param(SHORT_EDGE, 20, "none", id="an edge"),
        pytest.param(np.concatenate([SHORT_EDGE, spread(4)]), 20, "none", id="an edge and 4"),
        pytest.param(np.concatenate([SHORT_EDGE, spread(9)]), 20, "homography", id="an edge and 9"),
    ],
)
def test_evidence_is_counted_by_places(
    places: np.ndarray, wrong: int, expected: str, run_node: Any
) -> None:
    points0 = np.concatenate([places, anywhere(wrong, 1)])
    points1 = np.concatenate([moved(places), anywhere(wrong, 2)])
    model, agrees = estimate(run_node, points0, points1)
    assert model == expected
    # All that agree are said to, however near they are to each other.
    assert agrees[: len(places)].all() == (expected != "none")
    assert agrees[len(places) :].sum() <= 0.1 * wrong


def test_one_place_of_the_second_picture_is_one(run_node: Any) -> None:
    """As where many windows of a house are matched with one of them."""
    places = spread(20)
    into = np.array([320.0, 240.0]) + 0.02 * (places - places.mean(0))
    assert estimate(run_node, places, into)[0] == "none"
    assert estimate(run_node, into, places)[0] == "none"


def test_wrong_matches_have_no_geometry(run_node: Any) -> None:
    model, agrees = estimate(run_node, anywhere(60, 3), anywhere(60, 4))
    assert model == "none"
    assert not agrees.any()


def test_a_scene_with_depth_has_an_epipolar_geometry(run_node: Any) -> None:
    points0 = anywhere(120)
    shifts = np.random.default_rng(3).uniform(5, 90, 120)
    points1 = points0 - np.column_stack([shifts, np.zeros(120)])
    points1[:20] = anywhere(20, 9)
    model, agrees = estimate(run_node, points0, points1)
    assert model == "fundamental"
    assert agrees[20:].all()
    assert agrees[:20].mean() < 0.3


@pytest.mark.parametrize(("wrong", "enough"), [(0, 30), (60, 90), (200, 1000)])
@pytest.mark.parametrize("in_front", [0, 10, 30, 90])
def test_what_lies_before_a_plane_is_depth_if_it_is_enough(
    in_front: int, wrong: int, enough: int, run_node: Any
) -> None:
    """A plane with things in front of it, and wrong matches."""
    points0 = anywhere(150 + in_front + wrong)
    points1 = moved(points0)
    random = np.random.default_rng(5)
    shifts = random.uniform(8, 40, in_front)
    points1[150 : 150 + in_front] += shifts[:, None] * (0.9, 0.3)
    points1[150 + in_front :] = anywhere(wrong, 2)
    points1 += random.normal(0, 0.5, points1.shape)
    expected = "fundamental" if in_front >= enough else "homography"
    assert estimate(run_node, points0, points1)[0] == expected
