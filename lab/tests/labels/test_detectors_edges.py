from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage
from skimage import feature

from deepdetect_lab.labels import DETECTORS


@pytest.mark.parametrize(
    ("contrast", "marked"),
    # A step of c gives a gradient of 4 c: 248 is not above the high threshold 250, 252 is.
    [(30, False), (62, False), (63, True), (200, True)],
)
def test_canny_a_step_edge_is_one_pixel_thin(contrast: int, marked: bool) -> None:
    gray = np.full((30, 40), 20, np.uint8)
    gray[:, 17:] += contrast
    mask = DETECTORS["canny"].mask(gray)
    columns = np.flatnonzero(mask.any(0))
    assert len(columns) == marked
    if marked:
        assert columns[0] in (16, 17)
        assert mask[1:-1, columns[0]].all()


@pytest.mark.parametrize(
    ("weak", "marked"),
    # 4 * 37 = 148 is not above the low threshold 150, 4 * 38 = 152 is.
    [(37, False), (38, True)],
)
def test_canny_a_weak_edge_counts_when_it_continues_a_strong_one(weak: int, marked: bool) -> None:
    gray = np.zeros((60, 40), np.uint8)
    gray[:30, 17:] = 100
    gray[30:, 17:] = weak
    lower = DETECTORS["canny"].mask(gray)[40:58, 15:19]
    assert lower.any(1).all() == marked
    assert lower.any() == marked
    alone = np.zeros((60, 40), np.uint8)
    alone[:, 17:] = weak
    assert not DETECTORS["canny"].mask(alone).any()


def test_canny_agrees_with_scikit_image_up_to_a_pixel(gray: np.ndarray) -> None:
    blurred = cv2.GaussianBlur(gray, (0, 0), 1.5)
    ours = DETECTORS["canny"].mask(blurred, low_threshold=40.0, high_threshold=80.0)
    # scikit-image's gradient is the root of the sum of squares, OpenCV's the (larger) sum.
    theirs = feature.canny(blurred.astype(np.float64), sigma=0, low_threshold=40, high_threshold=80)
    near = np.ones((3, 3), np.uint8)
    assert ours.sum() > 1000
    assert theirs.sum() > 1000
    assert cv2.dilate(ours.astype(np.uint8), near).astype(bool)[theirs].mean() > 0.98


def sobel_kernels(size: int) -> tuple[np.ndarray, np.ndarray]:
    """The derivative and the smoothing kernel: binomials, as Sobel's are for any width."""
    smooth = np.ones(1)
    for _ in range(size - 2):
        smooth = np.convolve(smooth, [1, 1])
    return np.convolve(smooth, [-1, 1]), np.convolve(smooth, [1, 1])


@pytest.mark.parametrize(
    ("image", "size", "share"), [("gray", 11, 0.1), ("dark", 11, 0.5), ("square", 3, 0.1)]
)
def test_sobel_equals_scipy(
    image: str, size: int, share: float, request: pytest.FixtureRequest
) -> None:
    gray = request.getfixturevalue(image)
    derivative, smooth = sobel_kernels(size)

    def gradient(axis: int) -> np.ndarray:
        filtered = ndimage.correlate1d(gray.astype(np.float64), derivative, axis, mode="mirror")
        return ndimage.correlate1d(filtered, smooth, 1 - axis, mode="mirror")

    magnitude = np.hypot(gradient(0), gradient(1))
    mask = DETECTORS["sobel"].mask(gray, kernel_size=size, relative_threshold=share)
    assert 0.001 < mask.mean() < 0.9
    np.testing.assert_array_equal(mask, magnitude > share * magnitude.max())
