"""Rectified pairs of which every disparity is known exactly."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

Pair = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="session")
def rectified_pair() -> Callable[[np.ndarray], Pair]:
    """Return both views, (H, W) uint8, of a texture with a given (H, W) disparity.

    The texture is a sum of waves, so it is read at any place without interpolation.
    """

    def make(disparity: np.ndarray, seed: int = 0) -> Pair:
        generator = np.random.default_rng(seed)
        waves = generator.uniform(-1.6, 1.6, (60, 2))  # radians a pixel
        phases = generator.uniform(0, 2 * np.pi, 60)
        row, column = np.indices(disparity.shape)

        def read(x: np.ndarray) -> np.ndarray:
            total = sum(
                np.sin(a * x + b * row + phase) for (a, b), phase in zip(waves, phases, strict=True)
            )
            return np.rint(np.clip(128 + 18 * total, 0, 255)).astype(np.uint8)

        return read(column - disparity), read(column.astype(float))

    return make
