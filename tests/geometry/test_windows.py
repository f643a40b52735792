from __future__ import annotations

import numpy as np
import pytest

from deepdetect.geometry.images import gaussian_means, window_sums


@pytest.mark.parametrize("window", [1, 3, 9])
def test_sums_are_those_of_brute_force(window: int) -> None:
    generator = np.random.default_rng(0)
    rows, columns = np.nonzero(generator.random((20, 31)) < 0.4)
    pixels = np.column_stack([columns, rows])
    values = generator.normal(size=len(pixels))
    at = np.column_stack([generator.integers(0, 31, 50), generator.integers(0, 20, 50)])
    for places in (None, at):
        centres = pixels if places is None else places
        near = (np.abs(centres[:, None] - pixels) <= window // 2).all(2)
        found = window_sums(pixels, values, (20, 31), window, at=places)
        np.testing.assert_allclose(found, near @ values, atol=1e-9)


@pytest.fixture
def some() -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a 30x20 image, each once, and their values."""
    generator = np.random.default_rng(0)
    chosen = generator.permutation(600)[:150]
    return np.column_stack([chosen % 30, chosen // 30]), generator.normal(size=150)


def test_means_are_weighted_by_a_gaussian(some: tuple[np.ndarray, np.ndarray]) -> None:
    pixels, values = some
    inner = pixels[((pixels > 7) & (pixels < (22, 12))).all(axis=1)]  # away from the border
    squares = ((inner[:, None] - pixels) ** 2).sum(axis=2)
    weights = np.exp(-squares / (2 * 1.5**2))
    expected = weights @ values / weights.sum(axis=1)
    found = gaussian_means(pixels, values, (20, 30), 1.5, inner)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    same = gaussian_means(pixels, np.full(150, 7.0), (20, 30), 1.5, pixels)
    np.testing.assert_allclose(same, 7, rtol=1e-5)
