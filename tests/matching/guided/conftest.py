"""Pairs of images whose geometry is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair

WARP = np.array([[0.9, 0.12, 20.0], [-0.1, 0.95, 18.0], [2e-4, 1e-4, 1.0]])


@pytest.fixture(scope="module")
def second(photo: np.ndarray) -> np.ndarray:
    """The photograph, moved by `WARP` and darker."""
    moved = cv2.warpPerspective(photo, WARP, (256, 256), flags=cv2.INTER_CUBIC)
    return np.clip(moved * 0.8 + 10, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def warped_pair(photo: np.ndarray, second: np.ndarray) -> ImagePair:
    """The photograph and its moved copy."""
    return ImagePair((luma(photo), luma(second)))
