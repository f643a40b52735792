from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect_lab.evaluation.metrics.homography import (
    accuracy_at,
    area_under_curve,
    corner_error,
    inside,
    match_accuracy,
    project_visible,
)

ERRORS = st.lists(st.floats(0, 20) | st.just(math.inf), min_size=1, max_size=30)


def test_the_truth_has_no_error_and_nothing_has_an_infinite_one() -> None:
    assert corner_error(np.eye(3), np.eye(3), (640, 480)) == 0
    assert corner_error(-3 * np.eye(3), np.eye(3), (640, 480)) == 0  # the scale is free
    assert corner_error(None, np.eye(3), (640, 480)) == math.inf


def test_the_corners_are_the_centres_of_the_corner_pixels() -> None:
    stretch = np.diag([2.0, 1, 1])
    # Two corners stay, two move by width - 1.
    assert corner_error(stretch, np.eye(3), (11, 7)) == 5


def test_agrees_with_opencv() -> None:
    homography = np.array([[1.1, 0.05, -7], [-0.03, 0.95, 4], [1e-4, -2e-4, 1]])
    corners = np.array([[0, 0], [639, 0], [639, 479], [0, 479]], np.float64)
    moved = cv2.perspectiveTransform(corners[None], homography)[0]
    expected = np.linalg.norm(moved - corners, axis=1).mean()
    assert corner_error(homography, np.eye(3), (640, 480)) == pytest.approx(expected)


def test_shares_of_known_errors() -> None:
    errors = [0.5, 1.0, 2.0, math.inf]
    assert accuracy_at(errors, 1) == 0.5
    assert accuracy_at([], 1) == 0


@pytest.mark.parametrize(
    ("errors", "threshold", "expected"),
    [
        # Under the line from (0, 0) to (2, 1), then at 1 up to 5: 1 + 3 of 5.
        ([2.0], 5.0, 0.8),
        # (0, 0), (1, 1/4), (3, 2/4), then level to 4: .125 + .75 + .5 of 4.
        ([1.0, 3.0, math.inf, math.inf], 4.0, 0.34375),
        # Level at 0 to 4, as the next point is beyond: the curve is cut, not interpolated.
        ([6.0, 8.0], 4.0, 0.0),
        ([0.0, 0.0], 5.0, 1.0),
        ([math.inf, math.inf], 5.0, 0.0),
        ([], 5.0, 0.0),
        # The order is of no importance: (0, 0), (0, 1/3), (10, 2/3), level to 20.
        ([10.0, math.inf, 0.0], 20.0, (10 * 0.5 + 10 * 2 / 3) / 20),
    ],
)
def test_the_auc_is_that_of_superglue(errors: list[float], threshold: float, expected) -> None:
    assert area_under_curve(errors, threshold) == pytest.approx(expected)


def superglue_auc(errors: np.ndarray, threshold: float) -> float:
    """The published procedure, written again."""
    ordered = [0.0, *sorted(errors)]
    recall = [k / len(errors) for k in range(len(ordered))]
    last = sum(error < threshold for error in ordered)
    x, y = [*ordered[:last], threshold], [*recall[:last], recall[last - 1]]
    steps = zip(x, x[1:], y, y[1:], strict=False)
    return sum((b - a) * (low + high) / 2 for a, b, low, high in steps) / threshold


@given(errors=ERRORS, threshold=st.floats(0.5, 10))
def test_the_auc_of_many_errors_is_near_the_mean_of_the_shares(
    errors: list[float], threshold: float
) -> None:
    found = area_under_curve(errors, threshold)
    assert found == pytest.approx(superglue_auc(errors, threshold))
    steps = (np.arange(4000) + 0.5) / 4000 * threshold
    mean = np.mean([accuracy_at(errors, step) for step in steps])
    assert mean - 1e-3 < found < mean + 0.5 / len(errors) + 1e-3


HOMOGRAPHIES = st.builds(
    lambda angle, scale, shift, tilt: np.array(
        [
            [scale * math.cos(angle), -scale * math.sin(angle), shift[0]],
            [scale * math.sin(angle), scale * math.cos(angle), shift[1]],
            [tilt[0], tilt[1], 1],
        ]
    ),
    st.floats(-3, 3),
    st.floats(0.5, 2),
    st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
    st.tuples(st.floats(-5e-4, 5e-4), st.floats(-5e-4, 5e-4)),
)


@given(homography=HOMOGRAPHIES, factor=st.floats(0.1, 10), sign=st.sampled_from([-1, 1]))
def test_the_scale_and_sign_of_a_homography_do_not_matter(
    homography: np.ndarray, factor: float, sign: int
) -> None:
    other = sign * factor * homography
    assert corner_error(other, homography, (200, 150)) == pytest.approx(0, abs=1e-6)
    shift = np.array([[1.0, 0, 3], [0, 1, -4], [0, 0, 1]])
    assert corner_error(shift @ other, homography, (200, 150)) == pytest.approx(5)


def test_an_image_reaches_half_a_pixel_beyond_its_outer_centres() -> None:
    points = np.array([[-0.5, -0.5], [-0.51, 0], [9.49, 4.49], [9.5, 0], [0, 4.5], [np.nan, 0]])
    assert inside(points, (10, 5)).tolist() == [True, False, True, False, False, False]
    assert inside(np.array([[np.inf, 0]]), (10, 5)).tolist() == [False]


def test_points_outside_the_other_image_become_nan() -> None:
    shift = np.array([[1.0, 0, 3], [0, 1, 0], [0, 0, 1]])
    mapped = project_visible(np.array([[0, 0], [6, 4], [7, 4]]), shift, (10, 5))
    np.testing.assert_array_equal(mapped, [[3, 0], [9, 4], [np.nan, np.nan]])


@pytest.mark.parametrize("scale", [1.0, -2.5])
def test_beyond_the_horizon_nothing_is_seen(scale: float) -> None:
    # The depth is 1 - x / 100: the horizon is at x = 100.
    homography = scale * np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    points = np.array([[0.0, 0], [99, 0], [101, 0], [150, 0]])
    mapped = project_visible(points, homography, (10_000, 10))
    assert np.isfinite(mapped[:2]).all()
    assert np.isnan(mapped[2:]).all()
    # x = -300 + ... at 150 maps to -300, at 50 to 100.
    assert np.isnan(project_visible(np.array([[150.0, 0]]), homography, (1000, 10))).all()
    np.testing.assert_allclose(
        project_visible(np.array([[50.0, 0]]), homography, (1000, 10)), [[100, 0]]
    )


POINTS = np.array([[2.0, 2], [8, 2], [2, 8], [8, 8]])
SIZES = ((16, 16), (16, 16))


def accuracy(moved: np.ndarray, matched: int = 4, homography: np.ndarray = np.eye(3)):
    return match_accuracy(POINTS[:matched], moved[:matched], POINTS, moved, homography, SIZES)


def counts(found: dict) -> list[int]:
    return [found["correct", px] for px in (1, 3)]


def test_identity_is_all_right() -> None:
    found = accuracy(POINTS)
    assert counts(found) == [4, 4]
    assert found["precision", 3] == found["score", 3] == 1


def test_the_matching_score_counts_the_keypoints_seen_in_both() -> None:
    found = accuracy(POINTS, matched=1)
    assert found["precision", 3] == 1
    assert found["score", 3] == 0.25
    # Moved by 10 px, only the two at x = 2 stay in the image.
    shift = np.array([[1.0, 0, 10], [0, 1, 0], [0, 0, 1]])
    assert accuracy(POINTS + [10, 0], 1, shift)["score", 3] == 0.5


def test_no_matches_count_as_nothing_right() -> None:
    none = accuracy(POINTS, matched=0)
    assert none["precision", 3] == none["score", 3] == 0


@given(
    shift=st.tuples(st.floats(-12, 12), st.floats(-12, 12)),
    noise=st.lists(st.floats(0, 15), min_size=4, max_size=4),
)
def test_matches_off_by_known_distances_count_as_such(
    shift: tuple[float, float], noise: list[float]
) -> None:
    homography = np.array([[1.0, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]])
    moved = POINTS + shift + np.column_stack([noise, np.zeros(4)])
    found = accuracy(moved, homography=homography)
    errors = np.linalg.norm(moved - (POINTS + shift), axis=1)
    assert counts(found) == [int((errors <= t).sum()) for t in (1, 3)]
    for threshold in (1, 3):
        assert 0 <= found["score", threshold] <= 1
