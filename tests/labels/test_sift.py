from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.labels.sift import SiftSettings, sift_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("sift")


def blob(x: float, y: float, sigma: float) -> np.ndarray:
    rows, columns = np.mgrid[:64, :90]
    bump = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return np.rint(200 * bump).astype(np.uint8)


@pytest.mark.parametrize(("x", "y", "sigma"), [(40, 22, 4), (31, 40, 3), (61, 33, 5)])
def test_a_blob_is_marked_at_its_centre(x: int, y: int, sigma: float) -> None:
    mask = sift_mask(blob(x, y, sigma), SiftSettings())
    assert mask[y, x]


def test_equals_opencv_with_the_published_settings(gray: np.ndarray, naive_mask: Callable) -> None:
    # Arguments by position: features, octave layers, contrast, edge threshold, sigma.
    expected = naive_mask(gray, cv2.SIFT_create(0, 3, 0.04, 1000, 1.6))
    mask = sift_mask(gray, SiftSettings())
    assert mask.dtype == bool
    assert expected.sum() > 100
    np.testing.assert_array_equal(mask, expected)


def test_the_edge_test_is_all_but_off(gray: np.ndarray) -> None:
    # OpenCV's own default of 10 drops points on edges.
    assert sift_mask(gray, SiftSettings()).sum() > sift_mask(gray, SiftSettings(0.04, 10.0)).sum()


def test_agrees_with_scikit_image(gray: np.ndarray) -> None:
    feature = pytest.importorskip("skimage.feature")
    detector = feature.SIFT(upsampling=2, c_dog=0.04 / 3, c_edge=1000)
    detector.detect(gray)
    theirs = np.zeros(gray.shape, np.uint8)
    for row, column in np.rint(detector.positions).astype(int):
        theirs[row, column] = 1
    ours = sift_mask(gray, SiftSettings())
    near = cv2.dilate(theirs, np.ones((5, 5), np.uint8)).astype(bool)
    assert near[ours].mean() > 0.7
    assert near.mean() < 0.3  # by chance alone it would be this
