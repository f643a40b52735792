from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from deepdetect.labels.harris import HarrisSettings, harris_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("harris")


def reference(gray: np.ndarray, settings: HarrisSettings) -> tuple[np.ndarray, np.ndarray]:
    """The mask, and where it hangs on rounding, by SciPy's filters in float64."""
    ndimage = pytest.importorskip("scipy.ndimage")
    derivative, smooth = [-1, -2, 0, 2, 1], [1, 4, 6, 4, 1]  # Sobel of width 5
    image = gray.astype(np.float64)

    def gradient(axis: int) -> np.ndarray:
        filtered = ndimage.correlate1d(image, derivative, axis, mode="mirror")
        return ndimage.correlate1d(filtered, smooth, 1 - axis, mode="mirror")

    def window(product: np.ndarray) -> np.ndarray:
        return ndimage.uniform_filter(product, settings.block_size, mode="mirror")

    dx, dy = gradient(1), gradient(0)
    a, b, c = window(dx * dx), window(dx * dy), window(dy * dy)
    response = a * c - b * b - settings.k * (a + c) ** 2
    if settings.dilate:
        response = ndimage.maximum_filter(response, 3, mode="nearest")
    limit = settings.relative_threshold * response.max()
    return response > limit, abs(response - limit) < 1e-3 * limit


@pytest.mark.parametrize(
    "settings",
    [
        HarrisSettings(),
        HarrisSettings(dilate=False),
        HarrisSettings(k=0.04, relative_threshold=0.04),
    ],
)
@pytest.mark.parametrize("image", ["gray", "dark", "square"])
def test_equals_scipy(image: str, settings: HarrisSettings, request: pytest.FixtureRequest) -> None:
    gray = request.getfixturevalue(image)
    expected, unsure = reference(gray, settings)
    mask = harris_mask(gray, settings)
    assert mask.dtype == bool
    assert 0.005 < mask.mean() < 0.9
    assert unsure.mean() < 0.01
    np.testing.assert_array_equal(mask[~unsure], expected[~unsure])


def test_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = harris_mask(square, HarrisSettings())
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    assert count == 5  # the background and four blobs
    # A corner lies between the pixels; each blob is centred there and up to 8 pixels wide.
    corners = [(23.5, 19.5), (47.5, 19.5), (23.5, 43.5), (47.5, 43.5)]
    for x, y in corners:
        assert np.abs(centres[1:] - (x, y)).max(1).min() < 1.5
    assert stats[1:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max() <= 8
    np.testing.assert_array_equal(stats[1:, cv2.CC_STAT_AREA], stats[1, cv2.CC_STAT_AREA])


def test_the_middle_of_a_straight_edge_is_no_corner() -> None:
    gray = np.zeros((40, 60), np.uint8)
    gray[:, 30:] = 200
    assert not harris_mask(gray, HarrisSettings()).any()


def test_the_mask_turns_with_the_image(gray: np.ndarray) -> None:
    turned = harris_mask(np.ascontiguousarray(gray.T), HarrisSettings())
    assert (turned != harris_mask(gray, HarrisSettings()).T).mean() < 1e-3
