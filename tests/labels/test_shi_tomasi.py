from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from deepdetect.labels.shi_tomasi import ShiTomasiSettings, shi_tomasi_mask


def test_constant_images(marks_nothing_on_constant_images: Callable[[str], None]) -> None:
    marks_nothing_on_constant_images("shi-tomasi")


def test_the_corners_of_a_square(square: np.ndarray) -> None:
    mask = shi_tomasi_mask(square, ShiTomasiSettings())
    found = sorted(np.argwhere(mask)[:, ::-1].tolist())
    # A window of 2 pixels reaches to the left and above, so that its corners lie at its end.
    assert found == [[25, 21], [25, 43], [47, 21], [47, 43]]


def test_a_straight_edge_is_no_corner() -> None:
    gray = np.zeros((40, 60), np.uint8)
    gray[:, 30:] = 200
    assert not shi_tomasi_mask(gray, ShiTomasiSettings()).any()


@pytest.mark.parametrize("image", ["gray", "dark"])
def test_agrees_with_scipy(image: str, request: pytest.FixtureRequest) -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    gray = request.getfixturevalue(image)
    settings = ShiTomasiSettings()
    values = gray.astype(np.float64)
    dx, dy = (ndimage.sobel(values, axis, mode="mirror") for axis in (1, 0))
    a, b, c = (
        ndimage.uniform_filter(product, settings.block_size, mode="mirror")
        for product in (dx * dx, dx * dy, dy * dy)
    )
    smaller = (a + c) / 2 - np.sqrt(((a - c) / 2) ** 2 + b * b)
    largest_near = ndimage.maximum_filter(smaller, 3, mode="nearest")
    expected = (smaller > settings.quality_level * smaller.max()) & (
        smaller >= largest_near * (1 - 1e-6)
    )
    expected[[0, -1]] = expected[:, [0, -1]] = False  # OpenCV takes none on the border
    mask = shi_tomasi_mask(gray, settings)
    assert mask.dtype == bool
    assert mask.sum() > 200
    assert (mask & expected).sum() > 0.99 * max(mask.sum(), expected.sum())


def test_a_limit_keeps_the_strongest(gray: np.ndarray) -> None:
    every, some = (shi_tomasi_mask(gray, ShiTomasiSettings(corners=n)) for n in (0, 50))
    assert some.sum() == 50
    assert every.sum() > 200
    assert not (some & ~every).any()
