"""Keypoints and matches drawn on their images, and small tables in HTML for notebooks."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._shared.errors import ImageError
from .._shared.image_array import Channels, array_to_rgb, deep_values
from .._shared.opencv import cv2

MAX_CIRCLES = 5000
"""More keypoints than this are drawn as single pixels."""

LEAST_RADIUS_PX = 2.0
"""Of the circle of a keypoint that has a size; without one it is a pixel more."""

PICTURE_SIDE_PX = 2000
"""Longer side of a picture of matches: as JPEG it takes less than two megabytes."""

READABLE_WIDTH_PX = 800
"""Captions, lines and points grow with pictures that are wider than this."""

LINES, DOTS = 60, 1500
"""Of matches that have the colour of their position."""

MAX_SIDE_PX = 240
"""Of the picture of one image in a table."""

MAX_LINES = 60
"""Of matches in that picture."""

GREEN, RED = (60, 255, 60), (255, 60, 60)

Points = tuple[np.ndarray, tuple[int, int]]


def draw_keypoints(rgb: np.ndarray, xy: np.ndarray, sizes: np.ndarray | None) -> np.ndarray:
    """Draw keypoints on a (H, W, 3) uint8 RGB image, which is dimmed; as `Keypoints.draw`."""
    canvas, unit = rgb // 2, line_scale(rgb)
    if len(xy) > MAX_CIRCLES:
        # Half transparent, so that the image shows through the dense points.
        columns, rows = np.clip(np.rint(xy).astype(int), 0, np.array(rgb.shape[1::-1]) - 1).T
        canvas[rows, columns] = canvas[rows, columns] // 2 + np.array(GREEN, np.uint8) // 2
        return canvas
    least = LEAST_RADIUS_PX * unit
    radii = np.full(len(xy), least + unit) if sizes is None else np.maximum(sizes / 2, least)
    for centre, radius in zip(xy, radii, strict=True):
        draw_circle(canvas, centre, radius, GREEN, round(unit))
    return canvas


def draw_matches(
    rgb0: np.ndarray,
    rgb1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    good: np.ndarray,
    lines: int = 150,
    *,
    by_position: bool = False,
) -> np.ndarray:
    """Draw the two images side by side, with lines between a random sample of the matches.

    The lower image is enlarged to the height of the other, and both are scaled down where the
    picture would be wider or higher than `PICTURE_SIDE_PX`. Good matches are green, the others red;
    by position the good ones are coloured by their place in the first image, and most are dots.
    """
    height = max(rgb0.shape[0], rgb1.shape[0])
    width = sum(rgb.shape[1] * height / len(rgb) for rgb in (rgb0, rgb1))
    height = max(1, round(height * min(1.0, PICTURE_SIDE_PX / max(width, height))))
    shown = [_of_height(rgb, height) for rgb in (rgb0, rgb1)]
    canvas = cv2.convertScaleAbs(np.concatenate(shown, axis=1), alpha=0.7)
    points0, points1 = (
        (np.asarray(points, np.float64) + 0.5) * (view.shape[1] / rgb.shape[1], height / len(rgb))
        - 0.5
        for points, view, rgb in zip((points0, points1), shown, (rgb0, rgb1), strict=True)
    )
    good = np.asarray(good, bool)
    order = np.random.default_rng(0).permutation(len(points0))[: DOTS if by_position else lines]
    colors = np.where(good[order, None], GREEN, RED)
    if by_position:
        relative = points0[order] / (shown[0].shape[1], height)
        colors[good[order]] = _colors_of_positions(relative[good[order]])
    with_line = np.arange(len(order)) < (LINES if by_position else lines)
    unit = line_scale(canvas)
    for k in np.argsort(good[order], kind="stable"):  # the good ones on top
        row, color = order[k], tuple(int(v) for v in colors[k])
        start = tuple(int(v) for v in np.rint(points0[row]))
        end = tuple(int(v) for v in np.rint(points1[row] + [shown[0].shape[1], 0]))
        if with_line[k]:
            cv2.line(canvas, start, end, color, round(unit), cv2.LINE_AA)
        for point in (start, end):
            cv2.circle(canvas, point, round(2 * unit), color, -1, cv2.LINE_AA)
    return canvas


def _colors_of_positions(positions: np.ndarray) -> np.ndarray:
    """Return (N, 3) RGB colours of positions in [0, 1]: hue from left to right, dark downwards.

    None is red, which matches that are not good have.
    """
    x, y = np.clip(positions, 0, 1).T
    hsv = np.stack([20 + 120 * x, np.full(len(x), 230), 255 - 110 * y], 1)  # of 180, 255, 255
    hsv = np.rint(hsv).astype(np.uint8)[None]
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0] if len(x) else np.empty((0, 3), np.uint8)


def _of_height(rgb: np.ndarray, height: int) -> np.ndarray:
    width = max(1, round(rgb.shape[1] * height / len(rgb)))
    interpolation = cv2.INTER_LINEAR if height > len(rgb) else cv2.INTER_AREA
    return cv2.resize(rgb, (width, height), interpolation=interpolation)


def line_scale(picture: np.ndarray) -> float:
    """Return by how much captions, lines and points are enlarged."""
    return max(1.0, picture.shape[1] / READABLE_WIDTH_PX)


def draw_circle(
    canvas: np.ndarray, centre: np.ndarray, radius: float, color: Sequence[int], width: int
) -> None:
    """Draw a circle with sub-pixel position and radius."""
    x, y = np.rint(centre * 16).astype(int).tolist()
    cv2.circle(canvas, (x, y), round(radius * 16), tuple(color), width, cv2.LINE_AA, 4)


def checked_image(image: Any, size: tuple[int, int], channels: Channels) -> np.ndarray:
    """Return the image of keypoints of a (width, height), of any kind, as (H, W, 3) uint8 RGB."""
    if isinstance(image, (str, bytes)) or hasattr(image, "__fspath__"):
        raise ImageError("a picture needs the image itself, not a path: give load_image(path)")
    if hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        deep = image.mode.startswith(("I", "F"))  # which Pillow would clip
        image, channels = deep_values(image) if deep else np.asarray(image.convert("RGB")), "rgb"
    rgb = array_to_rgb(image, channels)
    if rgb.shape[1::-1] != size:
        raise ImageError(
            f"the image has {rgb.shape[1]}x{rgb.shape[0]} pixels, the keypoints are of "
            f"one of {size[0]}x{size[1]}: give the image that they were found in"
        )
    return rgb


def html_summary(
    title: str,
    rows: Mapping[str, str],
    points: Sequence[Points],
    lines: np.ndarray | None = None,
) -> str:
    """Return a small table in HTML, and a picture of positions, about ten kB.

    The positions are of one image or two, side by side; some of the (M, 4) `lines`, positions in
    the first and in the second, are drawn.
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
    """Return a (H, W, 3) uint8 BGR picture of positions, dark where none is."""
    scale = min(1.0, MAX_SIDE_PX / max(side for _, size in points for side in size))
    panels = []
    for xy, (width, height) in points:
        panel = np.zeros((max(1, round(height * scale)), max(1, round(width * scale))), np.uint8)
        limits = (panel.shape[1] - 1, panel.shape[0] - 1)
        column, row = np.clip(np.floor((xy + 0.5) * scale), 0, limits).astype(np.int64).T
        panel[row, column] = 160
        panels.append(panel)
    height = max(len(panel) for panel in panels)
    joined = np.hstack([np.pad(p, ((0, height - len(p)), (0, 0))) for p in panels])
    picture = np.repeat(joined[:, :, None] // 2, 3, axis=2)
    picture[..., 1] = joined
    if lines is not None:
        chosen = np.sort(np.random.default_rng(0).permutation(len(lines))[:MAX_LINES])
        for x0, y0, x1, y1 in lines[chosen] * scale:
            start, end = (round(x0), round(y0)), (round(x1) + panels[0].shape[1], round(y1))
            cv2.line(picture, start, end, (90, 220, 255))  # smooth ones take five times the bytes
    return picture
