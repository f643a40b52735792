from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image


@pytest.fixture
def collection(photo: np.ndarray, tmp_path: Path) -> Callable[..., Path]:
    """Write a folder of overlapping crops of a photograph: a/00.png, a/01.png, ..., b/..."""

    def write(count: int, side: int = 128, name: str = "photos") -> Path:
        folder = tmp_path / name
        for k in range(count):
            place = folder / "ab"[k % 2] / f"{k:02d}.png"
            place.parent.mkdir(parents=True, exist_ok=True)
            x, y = 8 * k % (256 - side), 8 * (8 * k // (256 - side)) % (256 - side)
            Image.fromarray(photo[y : y + side, x : x + side]).save(place)
        return folder

    return write


def content(path: Path) -> dict[str, np.ndarray]:
    """Return all arrays of an HDF5 file by their paths."""
    import h5py

    found: dict[str, np.ndarray] = {}

    def add(name: str, member: object) -> None:
        if isinstance(member, h5py.Dataset):
            found[name] = member[()]

    with h5py.File(path) as file:
        file.visititems(add)
    return found


@pytest.fixture
def same_content() -> Callable[[Path, Path], bool]:
    """Tell whether two HDF5 files have the same arrays under the same names."""

    def compare(first: Path, second: Path) -> bool:
        ours, theirs = content(first), content(second)
        return ours.keys() == theirs.keys() and all(
            value.dtype == theirs[name].dtype and np.array_equal(value, theirs[name])
            for name, value in ours.items()
        )

    return compare
