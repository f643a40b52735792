from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import OptionError
from deepdetect.evaluation.baselines import CLASSICAL, Features
from deepdetect.io.image import luma

SIZE = (256, 256)


def some(scores: list[float]) -> Features:
    """Points in a row with these scores, and a column of everything."""
    count = len(scores)
    numbers = np.arange(count)
    return Features(
        np.column_stack([numbers, numbers]),
        np.array(scores),
        (100, 50),
        numbers.astype(np.float32),
        numbers.astype(np.float32),
        numbers.astype(np.int32),
        np.repeat(numbers[:, None], 8, axis=1).astype(np.uint8),
    )


@pytest.mark.parametrize("name", ["sift", "orb", "brisk", "fast"])
def test_a_round_trip_through_opencv_changes_nothing(photo: np.ndarray, name: str) -> None:
    detectors = {
        "sift": cv2.SIFT_create(),
        "orb": cv2.ORB_create(),
        "fast": cv2.FastFeatureDetector_create(),
    }
    home = cv2 if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d
    given_points = (detectors.get(name) or home.BRISK_create()).detect(luma(photo), None)
    assert len(given_points) > 100
    back = Features.from_opencv(given_points, SIZE).to_opencv()
    for field in ("pt", "size", "angle", "response", "octave"):
        assert [getattr(p, field) for p in back] == [getattr(p, field) for p in given_points]


def test_points_that_are_all_alike_get_size_3_and_no_angle() -> None:
    (point,) = Features(np.array([[4, 5]]), np.array([0.5]), SIZE).to_opencv()
    assert (point.pt, point.size, point.angle, point.octave) == ((4, 5), 3, -1, 0)
    assert point.response == 0.5
    (point,) = Features(np.array([[4, 5]]), np.array([0.5]), SIZE).to_opencv(7.0, 90.0)
    assert (point.size, point.angle) == (7, 90)


def test_no_keypoints_are_features_too() -> None:
    nothing = Features.from_opencv((), SIZE)
    assert len(nothing) == 0
    assert nothing.xy.shape == (0, 2)
    assert nothing.to_opencv() == []
    assert nothing.density == 0
    assert len(nothing.best(5)) == 0


def test_the_best_are_those_with_the_highest_scores_in_their_own_order() -> None:
    assert some([0.1, 0.9, 0.5, 0.7]).best(2).xy[:, 0].tolist() == [1, 3]


def test_ties_for_the_best_are_spread_over_the_image() -> None:
    xy = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    best = Features(xy, np.ones(len(xy)), (64, 48)).best(12)
    assert len(np.unique(best.xy // 16, axis=0)) == 12
    assert some([0.5, 0.9, 0.5, 0.5, 0.9]).best(2).xy[:, 0].tolist() == [1, 4]


def test_each_position_is_once_among_the_distinct_with_its_best_score() -> None:
    xy = np.array([[1, 1], [2, 2], [1, 1], [3.5, 1], [2, 2]])
    found = Features(xy, np.array([0.2, 0.9, 0.7, 0.1, 0.3]), (8, 8)).distinct()
    assert found.xy.tolist() == [[2, 2], [1, 1], [3.5, 1]]
    np.testing.assert_allclose(found.scores, [0.9, 0.7, 0.1])
    assert len(found.distinct()) == 3


@given(scores=st.lists(st.integers(0, 4).map(float), max_size=30), count=st.integers(0, 35))
def test_the_best_have_the_highest_scores(scores: list[float], count: int) -> None:
    best = some(scores).best(count)
    chosen = best.xy[:, 0].astype(int).tolist()
    assert sorted(scores[row] for row in chosen) == sorted(sorted(scores, reverse=True)[:count])
    # All columns stay together.
    for column in (best.sizes, best.angles, best.octaves, best.descriptors[:, 3]):
        assert column.tolist() == sorted(chosen)


def test_choosing_rows_keeps_what_is_not_there_away() -> None:
    plain = Features(np.zeros((5, 2)), np.ones(5), (10, 10))[np.array([1, 3])]
    assert len(plain) == 2
    assert plain.sizes is plain.angles is plain.octaves is plain.descriptors is None
    assert plain.image_size == (10, 10)


def test_density_is_keypoints_a_pixel() -> None:
    assert some([1.0] * 10).density == 10 / 5000


@pytest.mark.parametrize(
    "change",
    [
        {"xy": np.zeros((3, 3))},
        {"xy": np.zeros(6)},
        {"scores": np.zeros(2)},
        {"scores": np.zeros((3, 1))},
        {"sizes": np.zeros(4)},
        {"descriptors": np.zeros((2, 8))},
    ],
)
def test_shapes_that_do_not_fit_are_an_error(change, one_line) -> None:
    right = {"xy": np.zeros((3, 2)), "scores": np.zeros(3), "image_size": (10, 10)}
    with pytest.raises(OptionError) as caught:
        Features(**{**right, **change})
    one_line(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_an_error(value: float) -> None:
    with pytest.raises(OptionError, match="finite"):
        Features(np.array([[value, 0]]), np.zeros(1), SIZE)
    with pytest.raises(OptionError, match="finite"):
        Features(np.zeros((1, 2)), np.array([value]), SIZE)


def test_descriptors_and_sizes_as_lists_can_be_chosen_from() -> None:
    lists = Features([[1, 2], [3, 4]], [0.1, 0.9], (8, 8), descriptors=[[1.0, 2.0], [3.0, 4.0]])
    assert np.asarray(lists.best(1).descriptors).tolist() == [[3, 4]]


def test_every_classical_method_keeps_its_points_inside_the_image(photo: np.ndarray) -> None:
    for method in CLASSICAL.values():
        if method.name.startswith("brisk"):
            continue  # it is slow and checked elsewhere
        xy = method.detect(photo[:128, :100]).xy
        assert ((xy > -0.5) & (xy < (99.5, 127.5))).all(), method.name
