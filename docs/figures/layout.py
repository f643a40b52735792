"""Layout of figures: panels with captions, headers, and the JPEG file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

MARGIN_PX = 4
CAPTION_PX = 30
TEXT_PX = 17
BACKGROUND, TEXT = (255, 255, 255), (35, 35, 35)


def caption(panel: np.ndarray, text: str, size: tuple[int, int]) -> np.ndarray:
    """Scale a panel to (width, height), and add a line of text below it."""
    picture = Image.fromarray(panel).resize(size, Image.Resampling.LANCZOS)
    whole = Image.new("RGB", (size[0] + 2 * MARGIN_PX, size[1] + CAPTION_PX), BACKGROUND)
    whole.paste(picture, (MARGIN_PX, 0))
    _write(whole, text, (MARGIN_PX + 2, size[1] + 4), size[0])
    return np.asarray(whole)


def header(titles: Sequence[str], width: int) -> np.ndarray:
    """Return a line of titles for columns of this width."""
    whole = Image.new("RGB", ((width + 2 * MARGIN_PX) * len(titles), CAPTION_PX), BACKGROUND)
    for k, title in enumerate(titles):
        _write(whole, title, ((width + 2 * MARGIN_PX) * k + MARGIN_PX + 2, 5), width)
    return np.asarray(whole)


def write_jpeg(picture: np.ndarray, path: Path, quality: int) -> None:
    """Write a figure, and print its size."""
    Image.fromarray(picture).save(path, quality=quality, optimize=True, progressive=True)
    height, width = picture.shape[:2]
    print(f"{path}: {width}x{height}, {path.stat().st_size / 1000:.0f} kB")


def _write(whole: Image.Image, text: str, place: tuple[int, int], width: int) -> None:
    size = TEXT_PX
    font = ImageFont.load_default(size)
    while font.getlength(text) > width - 4 and size > 8:
        size -= 1
        font = ImageFont.load_default(size)
    ImageDraw.Draw(whole).text(place, text, TEXT, font)
