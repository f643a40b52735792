from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

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
