from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest


@pytest.fixture(scope="session")
def textures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of four pictures of random blobs of all sizes."""
    folder = tmp_path_factory.mktemp("textures")
    for k in range(4):
        cv2.imwrite(str(folder / f"{k}.png"), texture(k))
    return folder


def texture(seed: int, side: int = 200) -> np.ndarray:
    generator = np.random.default_rng(seed)
    layers = [
        cv2.GaussianBlur(generator.standard_normal((side, side)), (0, 0), sigma) * sigma
        for sigma in (1.0, 2, 4, 8)
    ]
    total = np.sum(layers, axis=0)
    return np.uint8(255 * (total - total.min()) / np.ptp(total))


@pytest.fixture
def photo() -> np.ndarray:
    return texture(7, 320)
