from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect.labels.agast import AgastSettings, agast_mask
from deepdetect.labels.fast import FastSettings, fast_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("agast")


@pytest.mark.parametrize("threshold", [1, 5, 13, 30])
@pytest.mark.parametrize("image", ["gray", "dark", "square"])
def test_equals_fast(image: str, threshold: int, request: pytest.FixtureRequest) -> None:
    gray = request.getfixturevalue(image)
    mask = agast_mask(gray, AgastSettings(threshold=threshold))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, fast_mask(gray, FastSettings(threshold=threshold)))


@given(
    gray=arrays(np.uint8, st.tuples(st.integers(16, 24), st.integers(16, 24))),
    threshold=st.sampled_from([1, 13]),
)
def test_equals_fast_on_any_image(gray: np.ndarray, threshold: int) -> None:
    np.testing.assert_array_equal(
        agast_mask(gray, AgastSettings(threshold=threshold)),
        fast_mask(gray, FastSettings(threshold=threshold)),
    )


def test_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = agast_mask(square, AgastSettings())
    assert all(mask[y, x] for y in (20, 43) for x in (24, 47))
    assert not mask[25:39].any()
