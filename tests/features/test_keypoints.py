from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import OptionError
from deepdetect.features.keypoints import Keypoints, bayer_order, on_pixels
from deepdetect.io.image import luma

SIZE = (256, 256)


def some(scores: list[float]) -> Keypoints:
    """Points in a row with these scores, and a column of everything."""
    count = len(scores)
    numbers = np.arange(count)
    return Keypoints(
        np.column_stack([numbers, numbers]),
        np.array(scores),
        (100, 50),
        sizes=numbers,
        angles=numbers,
        octaves=numbers,
        descriptors=np.repeat(numbers[:, None], 8, axis=1).astype(np.uint8),
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
    back = Keypoints.from_opencv(given_points, SIZE).to_opencv()
    for field in ("pt", "size", "angle", "response", "octave"):
        assert [getattr(p, field) for p in back] == [getattr(p, field) for p in given_points]


def test_points_that_are_all_alike_get_size_3_and_no_angle() -> None:
    (point,) = Keypoints(np.array([[4, 5]]), np.array([0.5]), SIZE).to_opencv()
    assert (point.pt, point.size, point.angle, point.octave) == ((4, 5), 3, -1, 0)
    assert point.response == 0.5
    (point,) = Keypoints(np.array([[4, 5]]), np.array([0.5]), SIZE).to_opencv(7.0, 90.0)
    assert (point.size, point.angle) == (7, 90)


def test_ties_for_the_best_are_spread_over_the_image() -> None:
    xy = np.stack(np.meshgrid(np.arange(64), np.arange(48)), -1).reshape(-1, 2)
    best = Keypoints(xy, np.ones(len(xy)), (64, 48)).best(12)
    assert len(np.unique(best.xy // 16, axis=0)) == 12
    assert some([0.5, 0.9, 0.5, 0.5, 0.9]).best(2).xy[:, 0].tolist() == [1, 4]


def test_each_position_is_once_among_the_distinct_with_its_best_score() -> None:
    xy = np.array([[1, 1], [2, 2], [1, 1], [3.5, 1], [2, 2]])
    found = Keypoints(xy, np.array([0.2, 0.9, 0.7, 0.1, 0.3]), (8, 8)).distinct()
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


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_an_error(value: float) -> None:
    with pytest.raises(OptionError):
        Keypoints(np.array([[value, 0]]), np.zeros(1), SIZE)
    with pytest.raises(OptionError):
        Keypoints(np.zeros((1, 2)), np.array([value]), SIZE)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_all_numbers_but_logits_must_be_finite(value: float) -> None:
    columns = {"sizes": (2,), "angles": (2,), "descriptors": (2, 3)}
    for name, shape in columns.items():
        values = np.ones(shape, np.float32)
        assert len(Keypoints(np.zeros((2, 2)), np.zeros(2), SIZE, **{name: values})) == 2
        values[1] = value
        with pytest.raises(OptionError):
            Keypoints(np.zeros((2, 2)), np.zeros(2), SIZE, **{name: values})
    sure = Keypoints(np.zeros((2, 2)), np.zeros(2), SIZE, logits=[np.inf, -np.inf])
    assert sure.logits.tolist() == [np.inf, -np.inf]


POINTS = Keypoints([[1, 2], [3, 4], [5, 0]], [0.9, 0.6, 0.7], (8, 5))


@pytest.mark.parametrize(
    ("index", "kept"),
    [
        (slice(1, None), [1, 2]),
        (slice(None, None, -1), [2, 1, 0]),
        (slice(0, 0), []),
        ([2, 0], [2, 0]),
        ([], []),
        (np.array([1, 1]), [1, 1]),
        (np.array([True, False, True]), [0, 2]),
        (np.zeros(3, bool), []),
        (1, [1]),
        (-1, [2]),
        (np.int64(2), [2]),
    ],
)
def test_indexing(index: object, kept: list[int]) -> None:
    part = POINTS[index]
    assert isinstance(part, Keypoints)
    assert part.image_size == POINTS.image_size
    assert part.xy.shape == (len(kept), 2)
    np.testing.assert_array_equal(part.xy, POINTS.xy[kept].reshape(-1, 2))
    np.testing.assert_array_equal(part.scores, POINTS.scores[kept])


@pytest.mark.parametrize(
    "empty",
    [Keypoints.empty((8, 5)), Keypoints([], [], (8, 5)), Keypoints(np.empty((0, 2)), [], (8, 5))],
    ids=["empty()", "lists", "arrays"],
)
def test_no_keypoint(empty: Keypoints) -> None:
    assert len(empty) == 0
    assert empty.xy.shape == (0, 2)
    assert empty.scores.shape == (0,)
    assert list(empty) == []
    assert empty.density == 0
    assert len(empty[:]) == 0


def grid(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)


@given(width=st.integers(1, 70), height=st.integers(1, 70))
def test_each_pixel_has_a_rank_of_its_own(width: int, height: int) -> None:
    order = bayer_order(grid(width, height), (width, height))
    assert order.dtype == np.float32
    assert len(np.unique(order)) == width * height
    assert 0 <= order.min() <= order.max() < 1


def test_the_logits_rank_where_there_are_any() -> None:
    points = Keypoints(np.zeros((3, 2)), [1, 1, 1], (8, 8), logits=[20, 30, 25])
    assert points.best(2).logits.tolist() == [30, 25]


@pytest.mark.parametrize("name", ["logits", "sizes", "angles", "octaves", "descriptors"])
def test_every_column_needs_one_row_per_keypoint(name: str) -> None:
    with pytest.raises(OptionError, match=name):
        Keypoints(np.zeros((3, 2)), np.zeros(3), SIZE, **{name: np.zeros((2, 4))})


def test_whole_pixels_are_told_from_others() -> None:
    assert on_pixels([[0, 0], [7, 4]], (5, 8))
    assert on_pixels([[70, 40]])
    assert not on_pixels([[8, 4]], (5, 8))
    assert not on_pixels([[-1, 0]])
    assert not on_pixels([[1.5, 0]])


def test_features_for_lightglue() -> None:
    torch = pytest.importorskip("torch", reason="needs torch for its tensors")
    points = some([0.25, 0.5, 0.75])
    found = points.to_lightglue()
    assert {name: tuple(tensor.shape) for name, tensor in found.items()} == {
        "keypoints": (1, 3, 2),
        "keypoint_scores": (1, 3),
        "scales": (1, 3),
        "oris": (1, 3),
        "image_size": (1, 2),
        "descriptors": (1, 3, 8),
    }
    assert all(tensor.dtype == torch.float32 for tensor in found.values())
    assert found["image_size"].tolist() == [[100, 50]]
    np.testing.assert_array_equal(found["keypoints"][0], points.xy)
    np.testing.assert_array_equal(found["keypoint_scores"][0], points.scores)
    np.testing.assert_allclose(found["oris"][0], np.radians([0, 1, 2]), rtol=1e-6)
    plain = POINTS.to_lightglue(size=7, angle=90)
    assert "descriptors" not in plain
    assert plain["scales"].tolist() == [[7, 7, 7]]
    np.testing.assert_allclose(plain["oris"][0], np.full(3, np.pi / 2), rtol=1e-6)
    assert points.to_lightglue(scale="sigma")["scales"].tolist() == (found["scales"] / 2).tolist()


def test_lightglue_gets_no_angle_that_is_unset() -> None:
    pytest.importorskip("torch")
    points = Keypoints([[3, 4], [5, 6]], [1, 1], (9, 9), angles=np.array([-1, 90], np.float32))
    angles = points.to_lightglue(angle=45)["oris"]
    np.testing.assert_allclose(angles, np.deg2rad([[45, 90]]), rtol=1e-6)
