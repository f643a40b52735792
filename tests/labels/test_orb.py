from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from deepdetect.labels.orb import OrbSettings, orb_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("orb")


def test_the_corners_of_a_square(square: np.ndarray) -> None:
    row, column = np.nonzero(orb_mask(square, OrbSettings()))
    corners = [(24, 20), (47, 20), (24, 43), (47, 43)]
    distance = np.array(
        [
            [max(abs(column - x), abs(row - y)).max() for x, y in corners]
            for column, row in zip(column, row, strict=True)
        ]
    )
    assert distance.min(1).max() <= 2
    assert distance.min(0).max() <= 2


def test_equals_opencv_with_the_published_settings(gray: np.ndarray, naive_mask: Callable) -> None:
    detector = cv2.ORB_create(1_000_000)
    detector.setScaleFactor(1.2)
    detector.setNLevels(7)
    detector.setEdgeThreshold(13)
    detector.setFastThreshold(13)
    expected = naive_mask(gray, detector)
    mask = orb_mask(gray, OrbSettings())
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, expected)


def test_nothing_is_cut_off(gray: np.ndarray) -> None:
    mask, capped = (orb_mask(gray, OrbSettings(features=n)) for n in (1_000_000, 300))
    assert mask.sum() > 2 * capped.sum()


def test_nothing_near_the_border(gray: np.ndarray) -> None:
    mask = orb_mask(gray, OrbSettings(levels=1))
    inner = mask[13:-13, 13:-13]
    assert inner.sum() == mask.sum() > 100
    assert inner[0].any() | inner[-1].any() | inner[:, 0].any() | inner[:, -1].any()
