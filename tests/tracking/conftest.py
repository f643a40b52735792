from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture(scope="session")
def moving_photo() -> Callable[[int, tuple[int, int]], np.ndarray]:
    """Frame k of a camera that moves over a photograph by whole pixels."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photograph = data.astronaut()

    def frame(k: int, step: tuple[int, int] = (3, 2)) -> np.ndarray:
        x, y = 40 + step[0] * k, 30 + step[1] * k
        return np.ascontiguousarray(photograph[y : y + 240, x : x + 320])

    return frame


@pytest.fixture
def frame_folder(moving_photo, tmp_path: Path) -> Path:
    """Six frames of it as PNG files."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(6):
        Image.fromarray(moving_photo(k)).save(folder / f"{k:03d}.png")
    return folder
