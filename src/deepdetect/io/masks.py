"""Binary masks as PNG files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .image_file import open_image, reading_options


def save_mask(mask: np.ndarray, path: str | Path) -> None:
    """Write a (H, W) bool mask as a 1-bit PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode_mask(mask))


def encode_mask(mask: np.ndarray) -> bytes:
    """Encode a (H, W) bool mask as the content of a 1-bit PNG file."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(mask).save(content, format="PNG")
    return content.getvalue()


def load_mask(source: Any, *, max_megapixels: float | None = None) -> np.ndarray:
    """Read a mask of any bit depth as (H, W) bool: True where a pixel is brighter than half.

    In a file of zeros and ones alone, the ones are True. Arguments and errors: see `open_image`.
    """
    options = reading_options(max_megapixels=max_megapixels)
    with open_image(source, what="mask", options=options) as opened:
        deep = opened.mode.startswith("I")  # 16 bits per pixel
        values = np.asarray(opened if deep else opened.convert("L"))
    return values > (0 if values.max() <= 1 else 32767 if deep else 127)
