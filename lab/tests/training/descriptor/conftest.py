from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect_lab.training.teachers.readings import Reading, choose_points


def made_reading(gray: np.ndarray, seed: int = 0) -> Reading:
    """Points of a picture with codes and scores at random, as if teachers had been read."""
    rng = np.random.default_rng(seed)
    xy, sizes, places = choose_points(gray, rng)
    codes = [rng.normal(size=(len(xy), length)) for length in (64, 128)]
    codes = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in codes]
    scores = rng.random((len(xy), 2))
    numbers = (values.astype(np.float32) for values in (xy, sizes))
    halves = (values.astype(np.float16) for values in (np.hstack(codes), scores))
    return Reading(gray, *numbers, places, *halves)


@pytest.fixture(scope="session")
def made_readings(textures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of made readings of all textures but one."""
    folder = tmp_path_factory.mktemp("readings")
    for k, path in enumerate(sorted(textures.glob("*.png"))[:-1]):
        reading = made_reading(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), k)
        np.savez(folder / f"{path.stem}.npz", **reading._asdict())
    return folder
