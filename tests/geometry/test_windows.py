from __future__ import annotations

import numpy as np
import pytest

from deepdetect.geometry.windows import window_sums


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


def test_sums_are_of_the_type_of_the_values() -> None:
    pixels = np.array([[1, 1]])
    assert window_sums(pixels, np.float32(1), (3, 3, 3), 3).dtype == np.float32
    assert window_sums(pixels, 1.0, (3, 3), 3).dtype == np.float64


def test_no_points_have_no_sums() -> None:
    assert window_sums(np.empty((0, 2), np.int64), 1.0, (4, 5), 3).shape == (0,)
