"""Dense SIFT beside OpenCV's, which it must equal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepdetect._shared import machine
from deepdetect.features.sift import dense_sift, opencv_sift_descriptors, to_root_sift
from deepdetect.io.image import luma


def every_pixel(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()])


@pytest.mark.parametrize("size", [2.0, 3.0, 8.0])
def test_equals_opencv_on_every_pixel_of_a_photograph(photo: np.ndarray, size: float) -> None:
    gray = luma(photo)[:60, :90]
    xy = every_pixel(gray)
    found = dense_sift(gray, xy, size)
    difference = np.abs(found.astype(int) - opencv_sift_descriptors(gray, xy, size))
    assert found.dtype == np.uint8
    assert (difference == 0).mean() >= 0.999
    assert difference.max() <= 1


@given(
    width=st.integers(4, 150),
    height=st.integers(4, 120),
    size=st.floats(2, 8),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=25)
def test_equals_opencv_on_noise_of_any_shape(
    width: int, height: int, size: float, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    gray = generator.integers(0, 256, (height, width)).astype(np.uint8)
    xy = generator.integers(0, [width, height], (30, 2))
    difference = np.abs(
        dense_sift(gray, xy, size).astype(int) - opencv_sift_descriptors(gray, xy, size)
    )
    assert difference.max() <= 1
    assert (difference == 0).mean() >= 0.99


def test_follows_the_order_and_repetition_of_the_points(photo: np.ndarray) -> None:
    gray = luma(photo)
    xy = every_pixel(gray)
    chosen = np.random.default_rng(0).integers(0, len(xy), 5000)
    np.testing.assert_array_equal(dense_sift(gray, xy[chosen]), dense_sift(gray, xy)[chosen])


def test_does_not_depend_on_the_number_of_threads(
    photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    gray = luma(photo)
    xy = every_pixel(gray)
    found = []
    for count in (1, 7):
        monkeypatch.setattr(machine, "processor_count", lambda count=count: count)
        found.append(to_root_sift(dense_sift(gray, xy)))
    np.testing.assert_array_equal(found[0], found[1])
