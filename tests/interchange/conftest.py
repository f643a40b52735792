from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("h5py", reason="needs h5py")

from deepdetect import Keypoints, PointDetector
from deepdetect.interchange import Collection, PairMatches, match_folder

FOUNTAIN = ("0003", "0004", "0005", "0006")


@pytest.fixture
def small_collection() -> Collection:
    """Three photographs with a few keypoints, of known values."""
    rng = np.random.default_rng(0)
    keypoints = {
        name: Keypoints(
            rng.uniform(0, 100, (6, 2)),
            rng.random(6),
            (120, 110),
            sizes=rng.uniform(2, 9, 6),
            angles=rng.uniform(0, 360, 6),
            descriptors=rng.integers(0, 200, (6, 128)).astype(np.uint8),
        )
        for name in ("a.jpg", "sub/b.jpg", "c.jpg")
    }
    matches = {
        ("a.jpg", "sub/b.jpg"): PairMatches(np.array([[0, 3], [5, 1]]), np.array([0.75, 0.5])),
        ("c.jpg", "a.jpg"): PairMatches(np.array([[2, 2]]), np.array([0.25])),
    }
    return Collection(keypoints, matches)


@pytest.fixture(scope="session")
def fountain(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small copies of four photographs of a fountain."""
    folder = tmp_path_factory.mktemp("fountain") / "photos"
    folder.mkdir()
    for name in FOUNTAIN:
        with Image.open(shared / "data" / "fountain" / f"{name}.jpg") as image:
            size = (448, round(image.height * 448 / image.width))
            image.resize(size, Image.Resampling.LANCZOS).save(folder / f"{name}.jpg", quality=95)
    return folder


@pytest.fixture(scope="session")
def fountain_collection(fountain: Path) -> Collection:
    """Their keypoints and matches, all pairs."""
    pytest.importorskip("h5py", reason="needs h5py")
    return match_folder(fountain, PointDetector(1500), workers=1)
