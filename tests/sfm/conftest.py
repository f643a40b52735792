from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import Camera, Keypoints

FOUNTAIN = ("0003", "0004", "0005", "0006")


@pytest.fixture
def pycolmap():
    """The package, where it is installed; after OpenCV."""
    pytest.importorskip("h5py", reason="needs h5py")
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    from deepdetect.sfm.colmap import import_pycolmap

    return import_pycolmap()


@pytest.fixture(scope="session")
def write_fountain(shared: Path) -> Callable[..., Path]:
    """Write small copies of photographs of the fountain."""

    def write(folder: Path, names=FOUNTAIN, width: int = 384) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            with Image.open(shared / "data" / "fountain" / f"{name}.jpg") as image:
                size = (width, round(image.height * width / image.width))
                image.resize(size, Image.Resampling.LANCZOS).save(
                    folder / f"{name}.jpg", quality=95
                )
        return folder

    return write


@pytest.fixture
def write_scenes(pycolmap) -> Callable[..., None]:
    """Write a database of cameras that pass random points, by name: step and number of cameras."""
    from deepdetect.sfm.colmap import CameraIntrinsics, write_database

    def write(path: Path, steps: dict[str, tuple[np.ndarray, int]]) -> None:
        rng = np.random.default_rng(0)
        intrinsics = CameraIntrinsics.of_camera(Camera((640, 480), 500.0))
        images = {}
        matches = {}
        for scene, (step, count) in steps.items():
            points = rng.uniform((-5, -3, 7), (5, 3, 13), (400, 3))
            own: list[tuple[str, np.ndarray]] = []
            for number in range(count):
                seen = points - number * step
                xy = seen[:, :2] / seen[:, 2:] * 500 + (319.5, 239.5)
                inside = ((xy > 0) & (xy < (639, 479))).all(axis=1)
                own.append((f"{scene}{number}.jpg", np.flatnonzero(inside)))
                noisy = xy[inside] + rng.normal(0, 0.2, (inside.sum(), 2))
                noisy = noisy.clip(0, (639, 479))
                points_seen = Keypoints(noisy, np.ones(len(noisy)), (640, 480))
                images[own[-1][0]] = points_seen, intrinsics
            for (name0, rows0), (name1, rows1) in itertools.combinations(own, 2):
                rows = np.intersect1d(rows0, rows1, return_indices=True)[1:]
                matches[name0, name1] = np.column_stack(rows)
        write_database(path, images, matches)

    return write
