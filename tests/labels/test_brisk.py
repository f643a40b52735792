from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.labels.brisk import BriskSettings, brisk_mask


def create(threshold: int, octaves: int) -> cv2.Feature2D:
    home = cv2 if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d
    return home.BRISK_create(threshold, octaves)


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("brisk")


@pytest.mark.parametrize("image", ["gray", "dark", "square"])
def test_equals_opencv_with_the_published_settings(
    image: str, naive_mask: Callable, request: pytest.FixtureRequest
) -> None:
    gray = request.getfixturevalue(image)
    mask = brisk_mask(gray, BriskSettings())
    assert mask.dtype == bool
    assert mask.any()
    np.testing.assert_array_equal(mask, naive_mask(gray, create(11, 3)))


def test_marks_lie_at_the_corners_of_a_square(square: np.ndarray) -> None:
    corners = np.array([(24, 20), (47, 20), (24, 43), (47, 43)])
    marked = np.argwhere(brisk_mask(square, BriskSettings()))[:, ::-1]
    assert len(marked) > 0
    for point in marked:
        assert np.abs(corners - point).max(1).min() <= 2


def test_settings_are_kept_apart(gray: np.ndarray, naive_mask: Callable) -> None:
    # The detectors are made once and kept, which must not mix their settings up.
    for threshold, octaves in [(11, 3), (60, 3), (11, 0), (11, 3)]:
        np.testing.assert_array_equal(
            brisk_mask(gray, BriskSettings(threshold, octaves)),
            naive_mask(gray, create(threshold, octaves)),
        )
