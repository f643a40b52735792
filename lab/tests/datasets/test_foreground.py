from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError
from deepdetect.io.masks import load_mask
from deepdetect_lab.datasets.foreground import load_foreground


def save(path: Path, value: int = 255, size: tuple[int, int] = (20, 30)) -> None:
    Image.fromarray(np.full(size, value, np.uint8)).save(path)


def test_photographs_with_a_mask_are_listed_in_order(tmp_path: Path) -> None:
    for name in ("b.jpg", "b_mask.png", "a.png", "a_mask.png", "alone.jpg", "only_mask.png"):
        save(tmp_path / name)
    found = load_foreground(tmp_path)
    assert [(p.image.name, p.mask.name) for p in found] == [
        ("a.png", "a_mask.png"),
        ("b.jpg", "b_mask.png"),
    ]


def test_what_is_missing_or_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(ImageError):
        load_foreground(tmp_path)
    save(tmp_path / "a.jpg")
    (tmp_path / "a_mask.png").write_text("no picture")
    (photograph,) = load_foreground(tmp_path)
    with pytest.raises(ImageError, match=r"a_mask\.png"):
        load_mask(photograph.mask)


def test_the_shared_masks_fit_their_photographs(shared: Path) -> None:
    photographs = load_foreground(shared / "data" / "foreground")
    assert len(photographs) >= 60
    for photograph in photographs[:3]:
        with Image.open(photograph.image) as image:
            assert load_mask(photograph.mask).shape == image.size[::-1]
