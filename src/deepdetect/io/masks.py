"""Binary masks as PNG files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .._shared.atomic import write_whole
from .image import UPRIGHT, orientation_of
from .image_file import open_image

WHITES = (1, 255, 65535)
"""White in a mask file is one of these values. The file does not tell which, because a mask of 1, 8
or 16 bits may be stored in a file with more bits."""


def save_mask(mask: np.ndarray, path: str | Path) -> None:
    """Write a (H, W) bool mask as a 1-bit PNG, whole or not at all."""
    write_whole(path, encode_mask(mask))


def encode_mask(mask: np.ndarray) -> bytes:
    """Encode a (H, W) bool mask as the content of a 1-bit PNG file."""
    content = io.BytesIO()
    Image.fromarray(mask).save(content, format="PNG")
    return content.getvalue()


def load_mask(source: Any) -> np.ndarray:
    """Read a mask of any bit depth as (H, W) bool: True where a pixel is brighter than mid-grey.

    White is the smallest of `WHITES` that no pixel exceeds, or else the largest pixel value. Masks
    are turned upright, as in `load_image`. Arguments and errors are those of `open_image`.
    """
    with open_image(source, what="mask") as opened:
        deep = opened.mode.startswith("I")  # 16 or 32 bits per pixel
        values = np.asarray(opened if deep else opened.convert("L"))
        values = UPRIGHT.get(orientation_of(opened), np.asarray)(values)
    largest = int(values.max())
    return values > next((white for white in WHITES if largest <= white), largest) // 2
