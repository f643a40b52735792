from __future__ import annotations

from math import comb, log10, pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from deepdetect.geometry import (
    GeometryOptions,
    epipolar_errors,
    estimate_geometry,
    transfer_errors,
)
from deepdetect.geometry.estimation import MAX_LOG10_NFA, MINIMAL_SAMPLE_SIZE, log10_nfa

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
    count=st.integers(9, 3000),
    share=st.floats(0, 1),
    threshold=st.floats(0.5, 5),
    size=st.tuples(st.integers(50, 1200), st.integers(50, 1200)),
)
def test_more_inliers_are_less_likely_to_be_chance(
    kind: str, count: int, share: float, threshold: float, size: tuple[int, int]
) -> None:
    """Of as many matches, once they are more than chance alone would give."""
    drawn = MINIMAL_SAMPLE_SIZE[kind]
    inliers = drawn + 1 + int(share * (count - drawn - 2))
    assume(inliers < count)
    assume(inliers - drawn > count * chance(kind, threshold, size))
    fewer, more = (log10_nfa(near(k, count), kind, threshold, size) for k in (inliers, inliers + 1))
    assert more < fewer


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


def test_more_models_for_each_sample_are_less_trusted() -> None:
    """Each of them may be right by chance."""
    one, ten = (log10_nfa(near(20, 60), "essential", 3, SIZE, tried) for tried in (1, 10))
    assert ten == pytest.approx(one + 1)


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
