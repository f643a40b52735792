from __future__ import annotations

from fractions import Fraction

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.labels.points import empty_mask, keypoints_mask, pixels_mask

# Quarter pixels hit the halves often; any float finds the rest.
COORDINATES = st.integers(-12, 60).map(lambda n: n / 4) | st.floats(-1e6, 1e6)


def nearest(value: float) -> int:
    """The nearest whole number, halves to the even one, by exact fractions."""
    whole, rest = divmod(Fraction(value), 1)
    if rest == Fraction(1, 2):
        return int(whole) + int(whole) % 2
    return int(whole) + (rest > Fraction(1, 2))


@given(
    shape=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    points=st.lists(st.tuples(COORDINATES, COORDINATES), max_size=30),
)
def test_equals_a_plain_loop(shape: tuple[int, int], points: list[tuple[float, float]]) -> None:
    expected = np.zeros(shape, bool)
    for x, y in points:
        column, row = nearest(x), nearest(y)
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            expected[row, column] = True
    mask = pixels_mask(shape, np.array(points))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, expected)


@pytest.mark.parametrize(
    ("x", "column"),
    [(0.5, 0), (1.5, 2), (2.5, 2), (3.5, 4), (-0.5, 0), (1.49, 1), (1.51, 2), (4.4, 4)],
)
def test_halves_go_to_the_even_pixel(x: float, column: int) -> None:
    np.testing.assert_array_equal(
        np.argwhere(pixels_mask((5, 5), np.array([[x, 1.0]]))), [[1, column]]
    )
    np.testing.assert_array_equal(
        np.argwhere(pixels_mask((5, 5), np.array([[1.0, x]]))), [[column, 1]]
    )


@pytest.mark.parametrize("point", [(-0.6, 1), (1, -0.6), (4.6, 1), (1, 3.6), (5, 4), (-5, -5)])
def test_points_outside_are_left_out(point: tuple[float, float]) -> None:
    assert not pixels_mask((4, 5), np.array([point])).any()


@pytest.mark.parametrize(
    "points", [[], np.empty((0, 2)), np.empty((0, 1, 2), np.float32)], ids=["list", "2-D", "3-D"]
)
def test_no_point(points: object) -> None:
    mask = pixels_mask((4, 5), points)
    assert mask.shape == (4, 5)
    assert not mask.any()


def test_the_shape_of_opencv_corners() -> None:
    corners = np.array([[[3.0, 1.0]], [[0.0, 2.0]]], np.float32)
    assert np.argwhere(pixels_mask((4, 5, 3), corners)).tolist() == [[1, 3], [2, 0]]


def test_opencv_keypoints() -> None:
    gray = np.zeros((6, 9), np.uint8)
    keypoints = [cv2.KeyPoint(x, y, 3) for x, y in [(7.0, 2.0), (2.5, 3.5), (8.7, 1.0)]]
    assert np.argwhere(keypoints_mask(gray, keypoints)).tolist() == [[2, 7], [4, 2]]
    for none in ([], ()):
        np.testing.assert_array_equal(keypoints_mask(gray, none), empty_mask(gray))


def test_an_empty_mask() -> None:
    mask = empty_mask(np.ones((3, 4), np.uint8))
    assert mask.dtype == bool
    assert mask.shape == (3, 4)
    assert not mask.any()
