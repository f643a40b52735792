"""Drawing of keypoints and matches on their images, and their HTML tables for notebooks."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._shared.errors import ImageError
from .._shared.image_array import Channels, array_to_rgb, deep_values
from .._shared.opencv import cv2

MAX_SIDE_PX, MAX_LINES = 240, 60
"""The figure of an HTML summary has a longer side of at most MAX_SIDE_PX, so that the summary takes
about 10 kB, and shows at most MAX_LINES matches as lines. Chosen by hand."""

Points = tuple[np.ndarray, tuple[int, int]]


def checked_image(image: Any, size: tuple[int, int], channels: Channels) -> np.ndarray:
    """Convert an array, tensor or PIL image of this (width, height) to (H, W, 3) uint8 RGB."""
    if isinstance(image, (str, bytes)) or hasattr(image, "__fspath__"):
        raise ImageError("drawing needs the image itself, not a path: give load_image(path)")
    if hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        deep = image.mode.startswith(("I", "F"))  # Pillow would clip the values
        image, channels = deep_values(image) if deep else np.asarray(image.convert("RGB")), "rgb"
    rgb = array_to_rgb(image, channels)
    if rgb.shape[1::-1] != size:
        raise ImageError(
            f"the image has {rgb.shape[1]}x{rgb.shape[0]} pixels, but the keypoints were "
            f"detected in one of {size[0]}x{size[1]} pixels: give that image"
        )
    return rgb


def html_summary(
    title: str, rows: Mapping[str, str], points: Sequence[Points], lines: np.ndarray | None = None
) -> str:
    """Return HTML of about 10 kB with a small table and a figure of the positions of keypoints.

    `points` holds the positions and the (width, height) of one image, or of two, which are shown
    side by side. The rows of `lines`, (M, 4), are x0, y0 in the first image and x1, y1 in the
    second; at most `MAX_LINES` of them are drawn.
    """
    cells = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(text)}</td></tr>"
        for name, text in rows.items()
    )
    picture = _position_picture(points, lines)
    small = [cv2.IMWRITE_PNG_COMPRESSION, 9]
    data = base64.b64encode(cv2.imencode(".png", picture, small)[1].tobytes()).decode()
    return (
        f"<table><caption>{html.escape(title)}</caption>{cells}</table>"
        f'<img alt="positions" src="data:image/png;base64,{data}">'
    )


def _position_picture(points: Sequence[Points], lines: np.ndarray | None) -> np.ndarray:
    scale = min(1.0, MAX_SIDE_PX / max(side for _, size in points for side in size))
    sizes = [[max(1, round(side * scale)) for side in size] for _, size in points]
    widths, heights = zip(*sizes, strict=True)
    picture = np.zeros((max(heights), sum(widths), 3), np.uint8)
    for (xy, _), size, left in zip(points, sizes, (0, widths[0]), strict=False):
        places = np.clip(np.floor((xy + 0.5) * scale), 0, np.subtract(size, 1)).astype(np.int64)
        picture[places[:, 1], left + places[:, 0]] = (80, 160, 80)
    if lines is not None:
        chosen = np.sort(np.random.default_rng(0).permutation(len(lines))[:MAX_LINES])
        for x0, y0, x1, y1 in lines[chosen] * scale:
            start, end = (round(x0), round(y0)), (round(x1) + widths[0], round(y1))
            # Antialiased lines would make the PNG 5 times larger.
            cv2.line(picture, start, end, (90, 220, 255))
    return picture
