from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy import ndimage
from skimage import feature

from deepdetect_lab.labels import DETECTORS


def test_sift_equals_opencv_with_the_published_settings(
    gray: np.ndarray, naive_mask: Callable
) -> None:
    # Arguments by position: features, octave layers, contrast, edge threshold, sigma.
    expected = naive_mask(gray, cv2.SIFT_create(0, 3, 0.04, 1000, 1.6))
    mask = DETECTORS["sift"].mask(gray)
    assert expected.sum() > 100
    np.testing.assert_array_equal(mask, expected)


def test_sift_agrees_with_scikit_image(gray: np.ndarray) -> None:
    detector = feature.SIFT(upsampling=2, c_dog=0.04 / 3, c_edge=1000)
    detector.detect(gray)
    theirs = np.zeros(gray.shape, np.uint8)
    for row, column in np.rint(detector.positions).astype(int):
        theirs[row, column] = 1
    ours = DETECTORS["sift"].mask(gray)
    near = cv2.dilate(theirs, np.ones((5, 5), np.uint8)).astype(bool)
    assert near[ours].mean() > 0.7
    assert near.mean() < 0.3  # by chance alone it would be this


def test_orb_equals_opencv_with_the_published_settings(
    gray: np.ndarray, naive_mask: Callable
) -> None:
    detector = cv2.ORB_create(1_000_000)
    detector.setScaleFactor(1.2)
    detector.setNLevels(7)
    detector.setEdgeThreshold(13)
    detector.setFastThreshold(13)
    expected = naive_mask(gray, detector)
    mask = DETECTORS["orb"].mask(gray)
    np.testing.assert_array_equal(mask, expected)


def brisk_create(threshold: int, octaves: int) -> cv2.Feature2D:
    home = cv2 if hasattr(cv2, "BRISK_create") else cv2.xfeatures2d
    return home.BRISK_create(threshold, octaves)


def test_brisk_settings_are_kept_apart(gray: np.ndarray, naive_mask: Callable) -> None:
    # The detectors are made once and kept, which must not mix their settings up.
    for threshold, octaves in [(11, 3), (60, 3), (11, 0), (11, 3)]:
        np.testing.assert_array_equal(
            DETECTORS["brisk"].mask(gray, threshold=threshold, octaves=octaves),
            naive_mask(gray, brisk_create(threshold, octaves)),
        )


@pytest.mark.parametrize(
    ("contrast", "threshold", "marked"), [(13, 13, False), (14, 13, True), (2, 1, True)]
)
def test_fast_one_bright_pixel_must_exceed_the_threshold(
    contrast: int, threshold: int, marked: bool
) -> None:
    gray = np.full((30, 40), 100, np.uint8)
    gray[11, 17] += contrast
    mask = DETECTORS["fast"].mask(gray, threshold=threshold)
    assert mask[11, 17] == marked
    assert mask.sum() == marked


@pytest.mark.parametrize("threshold", [1, 13])
def test_fast_equals_scikit_image(gray: np.ndarray, threshold: int) -> None:
    expected = feature.corner_fast(gray.astype(np.float64), n=9, threshold=threshold) > 0
    mask = DETECTORS["fast"].mask(gray, threshold=threshold)
    assert expected.sum() > 100
    np.testing.assert_array_equal(mask, expected)


@pytest.mark.parametrize(("image", "threshold"), [("gray", 13), ("dark", 1), ("square", 30)])
def test_agast_equals_fast(image: str, threshold: int, request: pytest.FixtureRequest) -> None:
    gray = request.getfixturevalue(image)
    mask = DETECTORS["agast"].mask(gray, threshold=threshold)
    np.testing.assert_array_equal(mask, DETECTORS["fast"].mask(gray, threshold=threshold))


def harris_reference(
    gray: np.ndarray, k: float, share: float, dilate: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The mask, and where it hangs on rounding, by SciPy's filters in float64."""
    derivative, smooth = [-1, -2, 0, 2, 1], [1, 4, 6, 4, 1]  # Sobel of width 5
    image = gray.astype(np.float64)

    def gradient(axis: int) -> np.ndarray:
        filtered = ndimage.correlate1d(image, derivative, axis, mode="mirror")
        return ndimage.correlate1d(filtered, smooth, 1 - axis, mode="mirror")

    def window(product: np.ndarray) -> np.ndarray:
        return ndimage.uniform_filter(product, 3, mode="mirror")

    dx, dy = gradient(1), gradient(0)
    a, b, c = window(dx * dx), window(dx * dy), window(dy * dy)
    response = a * c - b * b - k * (a + c) ** 2
    if dilate:
        response = ndimage.maximum_filter(response, 3, mode="nearest")
    limit = share * response.max()
    return response > limit, abs(response - limit) < 1e-3 * limit


@pytest.mark.parametrize(
    ("image", "k", "share", "dilate"),
    [
        ("gray", 0.001, 0.001, True),
        ("dark", 0.001, 0.001, False),
        ("square", 0.04, 0.04, True),
    ],
)
def test_harris_equals_scipy(
    image: str, k: float, share: float, dilate: bool, request: pytest.FixtureRequest
) -> None:
    gray = request.getfixturevalue(image)
    expected, unsure = harris_reference(gray, k, share, dilate)
    mask = DETECTORS["harris"].mask(gray, k=k, relative_threshold=share, dilate=dilate)
    assert 0.005 < mask.mean() < 0.9
    assert unsure.mean() < 0.01
    np.testing.assert_array_equal(mask[~unsure], expected[~unsure])


def test_harris_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = DETECTORS["harris"].mask(square)
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    assert count == 5  # the background and four blobs
    # A corner lies between the pixels; each blob is centred there and up to 8 pixels wide.
    corners = [(23.5, 19.5), (47.5, 19.5), (23.5, 43.5), (47.5, 43.5)]
    for x, y in corners:
        assert np.abs(centres[1:] - (x, y)).max(1).min() < 1.5
    assert stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max() <= 8
    np.testing.assert_array_equal(stats[1:, cv2.CC_STAT_AREA], stats[1, cv2.CC_STAT_AREA])


def test_shi_tomasi_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = DETECTORS["shi-tomasi"].mask(square)
    found = sorted(np.argwhere(mask)[:, ::-1].tolist())
    # A window of 2 pixels reaches to the left and above, so that its corners lie at its end.
    assert found == [[25, 21], [25, 43], [47, 21], [47, 43]]


def test_shi_tomasi_agrees_with_scipy(gray: np.ndarray) -> None:
    values = gray.astype(np.float64)
    dx, dy = (ndimage.sobel(values, axis, mode="mirror") for axis in (1, 0))
    a, b, c = (
        ndimage.uniform_filter(product, 2, mode="mirror") for product in (dx * dx, dx * dy, dy * dy)
    )
    smaller = (a + c) / 2 - np.sqrt(((a - c) / 2) ** 2 + b * b)
    largest_near = ndimage.maximum_filter(smaller, 3, mode="nearest")
    expected = (smaller > 0.01 * smaller.max()) & (smaller >= largest_near * (1 - 1e-6))
    expected[[0, -1]] = expected[:, [0, -1]] = False  # OpenCV takes none on the border
    mask = DETECTORS["shi-tomasi"].mask(gray)
    assert mask.sum() > 200
    assert (mask & expected).sum() > 0.99 * max(mask.sum(), expected.sum())
