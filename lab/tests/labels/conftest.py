"""Drawn images and checks that the tests of the label detectors share."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.io.image import luma


@pytest.fixture
def square() -> np.ndarray:
    """A bright rectangle on black: columns 24..47, rows 20..43 of 80x64 pixels."""
    gray = np.zeros((64, 80), np.uint8)
    gray[20:44, 24:48] = 200
    return gray


@pytest.fixture(scope="session")
def gray(photo: np.ndarray) -> np.ndarray:
    """The photograph's luma, cut so that it is not square."""
    return np.ascontiguousarray(luma(photo)[:200])


@pytest.fixture(scope="session")
def dark(gray: np.ndarray) -> np.ndarray:
    """The same, with 32 grey levels."""
    return (gray // 8 + 10).astype(np.uint8)


@pytest.fixture(scope="session")
def naive_mask() -> Callable[[np.ndarray, cv2.Feature2D], np.ndarray]:
    """Run an OpenCV detector and mark its keypoints one by one, with Python's own rounding."""

    def mark(gray: np.ndarray, detector: cv2.Feature2D) -> np.ndarray:
        mask = np.zeros(gray.shape, bool)
        for keypoint in detector.detect(gray, None):
            x, y = keypoint.pt
            mask[round(y), round(x)] = True  # Python, too, rounds halves to even
        return mask

    return mark
