"""Points with known errors have known shares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect_lab.evaluation.metrics.stereo import disparity_scores, score_errors, stereo_score

TRUTH = np.full((4, 5), 10.0)
EVERY = np.column_stack([part.ravel() for part in np.indices((4, 5))[::-1]])


def accuracies(found: dict[str, float]) -> list[float]:
    return [value for title, value in found.items() if title.startswith("1 - bad")]


def test_known_errors_give_known_shares() -> None:
    perfect = disparity_scores(EVERY, TRUTH.ravel(), TRUTH)
    assert list(perfect.values())[:7] == [1, 1, 1, 1, 0, 1, 1]
    errors = np.array([0.4, 0.6, -1.5, 3.0, -9.0])
    found = disparity_scores(EVERY[:5], TRUTH.ravel()[:5] + errors, TRUTH)
    assert accuracies(found) == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert found["EPE, px"] == pytest.approx(np.abs(errors).mean())
    assert found["completeness at 1 px"] == pytest.approx(2 / 20)
    assert found["F-score"] == pytest.approx(2 * 0.4 * 0.1 / 0.5)
    assert accuracies(disparity_scores([[0, 0]], np.array([11.0]), TRUTH)) == [0, 1, 1, 1]


def test_unknown_truth_is_not_evaluated_and_not_asked_for() -> None:
    truth = TRUTH.copy()
    truth[0] = np.nan
    found = disparity_scores(EVERY[:10], TRUTH.ravel()[:10], truth)
    assert accuracies(found) == [1, 1, 1, 1]
    assert found["completeness at 1 px"] == pytest.approx(5 / 15)


@pytest.mark.parametrize("disparity", [[10.0] * 7, [10.0, 50], [50, 10.0]])
def test_a_pixel_counts_once_for_completeness_whatever_else_lies_on_it(disparity: list) -> None:
    found = disparity_scores([[0, 0]] * len(disparity), np.array(disparity), TRUTH)
    assert found["completeness at 1 px"] == pytest.approx(1 / 20)


def test_points_outside_are_not_evaluated_and_none_have_no_shares() -> None:
    found = disparity_scores([[-1, 0], [5, 0], [0, 4], [4, 3]], np.full(4, 10.0), TRUTH)
    assert found["completeness at 1 px"] == 1 / 20
    nothing = disparity_scores(np.empty((0, 2)), np.empty(0), TRUTH)
    assert np.isnan(accuracies(nothing)).all()
    assert nothing["completeness at 1 px"] == nothing["half-occluded, with a point"] == 0
    assert np.isnan(nothing["of these within 1 px"])


@given(st.lists(st.floats(-20, 20), min_size=1, max_size=20))
def test_shares_grow_with_the_tolerance(errors: list[float]) -> None:
    found = disparity_scores(EVERY[: len(errors)], 10 + np.array(errors), TRUTH)
    assert accuracies(found) == sorted(accuracies(found))
    complete = found["completeness at 1 px"]
    assert 0 <= complete <= len(errors) / 20
    assert found["F-score"] <= max(found["1 - bad-1"], complete) + 1e-12  # rounding


def test_known_answers() -> None:
    disparity = np.full((4, 10), 3.0, np.float32)
    disparity[2] = np.nan
    points0 = np.array([[5, 0], [5, 1], [5, 1], [5, 2], [9, 3]])
    points1 = np.array([[2, 0], [3, 1], [3.1, 1], [2, 2], [6, 1]])
    score = stereo_score(points0, points1, disparity)
    # Right, right by exactly one pixel, wrong by 1.1, not evaluated, wrong by two rows.
    assert score == {"matches": 5, "evaluated": 4, "correct": 2, "precision": 0.5}


def test_no_match_is_no_error() -> None:
    assert score_errors(np.zeros(0))["precision"] == 0
    assert score_errors(np.array([np.nan]))["precision"] == 0


def test_half_occluded_are_the_pixels_the_right_image_does_not_hold() -> None:
    column = np.arange(30)
    pixels = np.column_stack([part.ravel() for part in np.indices((2, 30))[::-1]])
    for shift in (-4.0, 6.6):
        truth = np.full((2, 30), shift)
        truth[1, 0] = np.nan
        place = np.rint(column - shift)
        expected = np.tile((place < 0) | (place > 29), (2, 1))
        expected[1, 0] = False
        for error, accuracy in ((1, 1), (1.1, 0)):
            found = disparity_scores(pixels, np.full(60, shift + error), truth)
            assert found["half-occluded, with a point"] == expected.sum() > 0
            assert found["of these within 1 px"] == accuracy
