"""Label masks as 1-bit PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..atomic import atomic_path
from ..errors import ImageError


def save_mask(mask: np.ndarray, path: str | Path) -> None:
    """Write a (H, W) bool mask as a 1-bit PNG, whole or not at all."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(mask).save(temporary, format="PNG")


def load_mask(path: str | Path) -> np.ndarray:
    """Read a mask of any bit depth: True where a pixel is brighter than half.

    Returns:
        (H, W) bool.

    Raises:
        ImageError: the file is missing, damaged or no image.
    """
    from PIL import Image

    try:
        with Image.open(path) as opened:
            return np.asarray(opened.convert("L")) > 127
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"{path} is not a mask that can be read ({error})") from None
