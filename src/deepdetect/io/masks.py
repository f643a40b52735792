"""Binary masks as PNG files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import ImageError

SETTINGS_KEY = "deepdetect-label"
"""Keyword of the PNG text chunk that holds the settings a mask was made with."""


def save_mask(mask: np.ndarray, path: str | Path, settings: str = "") -> None:
    """Write a (H, W) bool mask as a 1-bit PNG, whole or not at all.

    Args:
        mask: the mask.
        path: file ending in .png.
        settings: text stored in the file, which `load_mask_settings` returns.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode_mask(mask, settings))


def encode_mask(mask: np.ndarray, settings: str = "") -> bytes:
    """Encode a (H, W) bool mask as the content of a 1-bit PNG file."""
    from PIL import Image, PngImagePlugin

    chunks = PngImagePlugin.PngInfo()
    if settings:
        chunks.add_text(SETTINGS_KEY, settings)
    content = io.BytesIO()
    Image.fromarray(mask).save(content, format="PNG", pnginfo=chunks)
    return content.getvalue()


def load_mask(path: str | Path | bytes) -> np.ndarray:
    """Read a mask of any bit depth: True where a pixel is brighter than half.

    In a file that holds only zeros and ones, the ones are True.

    Args:
        path: the file, or its content.

    Returns:
        (H, W) bool.

    Raises:
        ImageError: the file is missing, damaged or no image.
    """
    from PIL import Image

    name = "the mask" if isinstance(path, bytes) else path
    try:
        with Image.open(io.BytesIO(path) if isinstance(path, bytes) else path) as opened:
            deep = opened.mode.startswith("I")  # 16 bits per pixel
            values = np.asarray(opened if deep else opened.convert("L"))
        return values > (0 if values.max() <= 1 else 32767 if deep else 127)
    except FileNotFoundError:
        raise ImageError(f"there is no mask {name}: check the path") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"{name} is not a mask that can be read ({error})") from None


def load_mask_settings(path: str | Path) -> str | None:
    """Return the settings text stored in a mask file, or None when it has none."""
    from PIL import Image

    try:
        with Image.open(path) as opened:
            return opened.info.get(SETTINGS_KEY)
    except (OSError, SyntaxError, ValueError):
        return None
