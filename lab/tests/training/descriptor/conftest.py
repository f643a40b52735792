from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest


@pytest.fixture(scope="session")
def textures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three pictures of random blobs of all sizes."""
    folder, generator = tmp_path_factory.mktemp("textures"), np.random.default_rng(5)
    for k in range(3):
        layers = [
            cv2.GaussianBlur(generator.standard_normal((480, 480)), (0, 0), sigma) * sigma
            for sigma in (1.0, 2, 4, 8)
        ]
        total = np.sum(layers, axis=0)
        cv2.imwrite(str(folder / f"{k}.png"), np.uint8(255 * (total - total.min()) / np.ptp(total)))
    return folder
