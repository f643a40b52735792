from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deepdetect.labels.fast import FastSettings, fast_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("fast")


def test_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = fast_mask(square, FastSettings())
    row, column = np.nonzero(mask)
    for y in (20, 43):
        for x in (24, 47):
            assert mask[y, x]
            near = (abs(column - x) <= 2) & (abs(row - y) <= 2)
            assert near.sum() == mask.sum() / 4


@pytest.mark.parametrize("shape", [(40, 50), (41, 33)])
def test_a_straight_edge_is_no_corner(shape: tuple[int, int]) -> None:
    gray = np.zeros(shape, np.uint8)
    gray[:, 20:] = 200
    assert not fast_mask(gray, FastSettings()).any()


@pytest.mark.parametrize(
    ("contrast", "threshold", "marked"), [(13, 13, False), (14, 13, True), (2, 1, True)]
)
def test_one_bright_pixel_must_exceed_the_threshold(
    contrast: int, threshold: int, marked: bool
) -> None:
    gray = np.full((30, 40), 100, np.uint8)
    gray[11, 17] += contrast
    mask = fast_mask(gray, FastSettings(threshold=threshold))
    assert mask[11, 17] == marked
    assert mask.sum() == marked


@pytest.mark.parametrize("threshold", [1, 13, 40])
def test_equals_scikit_image(gray: np.ndarray, threshold: int) -> None:
    feature = pytest.importorskip("skimage.feature")
    expected = feature.corner_fast(gray.astype(np.float64), n=9, threshold=threshold) > 0
    mask = fast_mask(gray, FastSettings(threshold=threshold))
    assert expected.sum() > 100
    np.testing.assert_array_equal(mask, expected)


def test_the_low_setting_marks_more(dark: np.ndarray) -> None:
    normal, low = (fast_mask(dark, FastSettings(threshold=t)) for t in (13, 1))
    assert low.sum() > 5 * normal.sum()
    assert (low | normal).sum() == low.sum()


def test_suppression_keeps_a_part(gray: np.ndarray) -> None:
    every, best = (fast_mask(gray, FastSettings(suppression=s)) for s in (False, True))
    assert 0 < best.sum() < every.sum()
    assert (every | best).sum() == every.sum()
