from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deepdetect.labels.sobel import SobelSettings, sobel_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("sobel")


def kernels(size: int) -> tuple[np.ndarray, np.ndarray]:
    """The derivative and the smoothing kernel: binomials, as Sobel's are for any width."""
    smooth = np.ones(1)
    for _ in range(size - 2):
        smooth = np.convolve(smooth, [1, 1])
    return np.convolve(smooth, [-1, 1]), np.convolve(smooth, [1, 1])


@pytest.mark.parametrize("share", [0.1, 0.5])
@pytest.mark.parametrize("size", [3, 11])
@pytest.mark.parametrize("image", ["gray", "dark", "square"])
def test_equals_scipy(image: str, size: int, share: float, request: pytest.FixtureRequest) -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    gray = request.getfixturevalue(image)
    derivative, smooth = kernels(size)

    def gradient(axis: int) -> np.ndarray:
        filtered = ndimage.correlate1d(gray.astype(np.float64), derivative, axis, mode="mirror")
        return ndimage.correlate1d(filtered, smooth, 1 - axis, mode="mirror")

    magnitude = np.hypot(gradient(0), gradient(1))
    mask = sobel_mask(gray, SobelSettings(size, share))
    assert mask.dtype == bool
    assert 0.001 < mask.mean() < 0.9
    np.testing.assert_array_equal(mask, magnitude > share * magnitude.max())


def test_a_step_edge_is_a_band_around_it() -> None:
    gray = np.zeros((40, 60), np.uint8)
    gray[:, 30:] = 50
    derivative, _ = kernels(11)
    # At distance d from the step the response is a running sum of the derivative kernel.
    response = np.abs(np.cumsum(derivative))[:-1]
    width = int((response > 0.1 * response.max()).sum())
    mask = sobel_mask(gray, SobelSettings())
    assert width == 6
    np.testing.assert_array_equal(np.flatnonzero(mask.all(0)), np.arange(27, 33))
    np.testing.assert_array_equal(np.flatnonzero(mask.any(0)), np.arange(27, 33))


def test_the_mask_turns_with_the_image(gray: np.ndarray) -> None:
    turned = sobel_mask(np.ascontiguousarray(gray.T), SobelSettings())
    np.testing.assert_array_equal(turned, sobel_mask(gray, SobelSettings()).T)
