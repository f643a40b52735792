from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.matching import match_accuracy

POINTS = np.array([[2.0, 2], [8, 2], [2, 8], [8, 8]])
SIZES = ((16, 16), (16, 16))


def accuracy(moved: np.ndarray, matched: int = 4, homography: np.ndarray = np.eye(3)):
    return match_accuracy(POINTS[:matched], moved[:matched], POINTS, moved, homography, SIZES)


def test_identity_is_all_right() -> None:
    found = accuracy(POINTS)
    assert found.correct == (4,) * 10
    assert found.precision(3) == found.matching_score(3) == 1


def test_one_of_four_off_by_one_and_a_half() -> None:
    found = accuracy(POINTS + [[0, 0], [1.5, 0], [0, 0], [0, 0]])
    assert found.correct == (3, *([4] * 9))
    assert found.precision(1) == 0.75
    assert found.matching_score(1) == 0.75


def test_an_error_of_exactly_the_threshold_is_right() -> None:
    assert accuracy(POINTS + [[0, 0], [0, 0], [0, 0], [0, 2]]).correct[:2] == (3, 4)


def test_the_matching_score_counts_the_keypoints_seen_in_both() -> None:
    found = accuracy(POINTS, matched=1)
    assert found.precision(3) == 1
    assert found.matching_score(3) == 0.25
    # Moved by 10 px, only the two at x = 2 stay in the image.
    shift = np.array([[1.0, 0, 10], [0, 1, 0], [0, 0, 1]])
    assert accuracy(POINTS + [10, 0], 1, shift).matching_score(3) == 0.5


def test_no_matches_count_as_nothing_right() -> None:
    none = accuracy(POINTS, matched=0)
    assert none.precision(3) == none.matching_score(3) == 0


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
    assert found.correct == tuple(int((errors <= t).sum()) for t in range(1, 11))
    for threshold in (1, 3, 10):
        assert 0 <= found.matching_score(threshold) <= 1
