"""Points with known errors have known shares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.stereo import (
    DISPARITY_TOLERANCES_PX,
    disparity_accuracy,
    half_occluded_accuracy,
    score_errors,
    stereo_score,
)

TRUTH = np.full((4, 5), 10.0)
EVERY = np.column_stack([part.ravel() for part in np.indices((4, 5))[::-1]])


def test_the_truth_itself_is_perfect() -> None:
    found = disparity_accuracy(EVERY, TRUTH.ravel(), TRUTH)
    assert found.accuracy == (1, 1, 1, 1)
    assert (found.epe_px, found.completeness, found.f_score) == (0, 1, 1)


def test_known_errors_give_known_shares() -> None:
    errors = np.array([0.4, 0.6, -1.5, 3.0, -9.0])
    found = disparity_accuracy(EVERY[:5], TRUTH.ravel()[:5] + errors, TRUTH)
    assert found.accuracy == pytest.approx((0.2, 0.4, 0.6, 0.8))
    assert found.epe_px == pytest.approx(np.abs(errors).mean())
    assert found.completeness == pytest.approx(2 / 20)
    assert found.f_score == pytest.approx(2 * 0.4 * 0.1 / 0.5)


def test_an_error_of_the_tolerance_is_within_it() -> None:
    found = disparity_accuracy([[0, 0]], np.array([11.0]), TRUTH)
    assert dict(zip(DISPARITY_TOLERANCES_PX, found.accuracy, strict=True)) == {
        0.5: 0,
        1: 1,
        2: 1,
        4: 1,
    }


def test_unknown_truth_is_not_evaluated_and_not_asked_for() -> None:
    truth = TRUTH.copy()
    truth[0] = np.nan
    found = disparity_accuracy(EVERY[:10], TRUTH.ravel()[:10], truth)
    assert found.accuracy == (1, 1, 1, 1)
    assert found.completeness == pytest.approx(5 / 15)


def test_a_pixel_with_many_points_counts_once_for_completeness() -> None:
    found = disparity_accuracy([[0, 0]] * 7, np.full(7, 10.0), TRUTH)
    assert found.completeness == pytest.approx(1 / 20)


def test_one_wrong_point_does_not_undo_a_right_one_on_its_pixel() -> None:
    for disparity in ([10.0, 50], [50, 10.0]):
        found = disparity_accuracy([[0, 0]] * 2, np.array(disparity), TRUTH)
        assert found.completeness == pytest.approx(1 / 20)


def test_points_outside_are_counted_and_not_evaluated() -> None:
    found = disparity_accuracy([[-1, 0], [5, 0], [0, 4], [4, 3]], np.full(4, 10.0), TRUTH)
    assert found.completeness == 1 / 20


def test_no_points_have_no_shares() -> None:
    found = disparity_accuracy(np.empty((0, 2)), np.empty(0), TRUTH)
    assert np.isnan(found.accuracy).all()
    assert found.completeness == 0


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=20))
def test_shares_grow_with_the_tolerance(errors: list[float]) -> None:
    found = disparity_accuracy(EVERY[: len(errors)], 10 + np.array(errors), TRUTH)
    assert list(found.accuracy) == sorted(found.accuracy)
    assert 0 <= found.completeness <= len(errors) / 20
    assert found.f_score <= max(found.accuracy[1], found.completeness) + 1e-12  # rounding


def test_known_answers() -> None:
    disparity = np.full((4, 10), 3.0, np.float32)
    disparity[2] = np.nan
    points0 = np.array([[5, 0], [5, 1], [5, 1], [5, 2], [9, 3]])
    points1 = np.array([[2, 0], [3, 1], [3.1, 1], [2, 2], [6, 1]])
    score = stereo_score(points0, points1, disparity)
    # Right, right by exactly one pixel, wrong by 1.1, not evaluated, wrong by two rows.
    assert (score.matches, score.evaluated, score.correct) == (5, 4, 2)
    assert score.precision == 0.5


def test_no_match_is_no_error() -> None:
    assert score_errors(np.zeros(0)).precision == 0
    assert score_errors(np.array([np.nan])).precision == 0


def test_half_occluded_are_the_pixels_the_right_image_does_not_hold() -> None:
    column = np.arange(30)
    pixels = np.column_stack([part.ravel() for part in np.indices((2, 30))[::-1]])
    for shift in (-4.0, 0.4, 6.6):
        truth = np.full((2, 30), shift)
        truth[1, 0] = np.nan
        place = np.rint(column - shift)
        expected = np.tile((place < 0) | (place > 29), (2, 1))
        expected[1, 0] = False
        count = int(expected.sum())
        if count:
            assert half_occluded_accuracy(pixels, np.full(60, shift + 1), truth) == (count, 1)
            assert half_occluded_accuracy(pixels, np.full(60, shift + 1.1), truth) == (count, 0)
    number, fraction = half_occluded_accuracy(np.empty((0, 2)), np.empty(0), TRUTH)
    assert number == 0
    assert np.isnan(fraction)
