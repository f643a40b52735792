from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared.errors import OptionError
from deepdetect_lab.labels.detectors import (
    DETECTORS,
    pixels_mask,
    select_detectors,
)

NAMES = ("sift", "orb", "brisk", "fast", "agast", "harris", "shi-tomasi", "canny", "sobel")


@pytest.mark.parametrize("name", NAMES)
def test_masks_are_boolean_and_of_the_images_size(name: str, gray: np.ndarray) -> None:
    detector = DETECTORS[name]
    for settings in ({}, detector.low_visibility):
        before = gray.copy()
        mask = detector.mask(gray, **settings)
        assert (mask.dtype, mask.shape) == (bool, gray.shape)
        assert mask.any()
        np.testing.assert_array_equal(gray, before)


@pytest.mark.parametrize("name", NAMES)
def test_constant_images_are_not_marked(name: str) -> None:
    detector = DETECTORS[name]
    for settings in ({}, detector.low_visibility):
        for level in (0, 1, 128, 255):
            for shape in ((16, 16), (17, 23)):
                mask = detector.mask(np.full(shape, level, np.uint8), **settings)
                assert not mask.any(), (settings, level, shape)


@given(st.lists(st.sampled_from(NAMES), min_size=1, max_size=12))
def test_a_selection_has_the_order_of_the_registry(names: list[str]) -> None:
    assert list(select_detectors(names)) == [name for name in NAMES if name in names]


def test_an_unknown_name_is_told_the_nearest() -> None:
    with pytest.raises(OptionError, match="'shi-tomasi'"):
        select_detectors(["fast", "shi_tomasi"])


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
def test_pixels_equals_a_plain_loop(
    shape: tuple[int, int], points: list[tuple[float, float]]
) -> None:
    expected = np.zeros(shape, bool)
    for x, y in points:
        column, row = nearest(x), nearest(y)
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            expected[row, column] = True
    mask = pixels_mask(shape, np.array(points))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, expected)
