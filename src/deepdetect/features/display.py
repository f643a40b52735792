"""Keypoints and matches in notebooks: plots with matplotlib, and small tables in HTML."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._shared.errors import ImageError, MissingExtraError
from .._shared.image_array import Channels, array_to_rgb
from .._shared.opencv import cv2

MAX_CIRCLES = 5000
"""More keypoints than this are plotted as single pixels."""

MAX_SIDE_PX = 240
"""Of the picture of one image in a table."""

MAX_LINES = 60
"""Of matches in that picture."""

Points = tuple[np.ndarray, tuple[int, int]]


def plot_keypoints(
    xy: np.ndarray,
    size: tuple[int, int],
    diameters: np.ndarray | None,
    image: Any,
    axes: Any,
    channels: Channels,
    color: str,
) -> Any:
    """Plot keypoints over their image; arguments as of `Keypoints.plot`. Return the axes."""
    axes = _prepared_axes(axes, [(image, size)], channels)
    if diameters is None or len(xy) > MAX_CIRCLES:
        # Circles of 3 px when they are few, else pixels.
        marker = "," if len(xy) > MAX_CIRCLES else "o"
        style = {"markersize": 4, "markerfacecolor": "none", "markeredgecolor": color}
        axes.plot(*xy.T, marker, color=color, **(style if marker == "o" else {}))
        return axes
    from matplotlib.collections import EllipseCollection

    circles = EllipseCollection(
        diameters,
        diameters,
        np.zeros(len(xy)),
        units="xy",
        offsets=xy,
        offset_transform=axes.transData,
        facecolors="none",
        edgecolors=color,
    )
    axes.add_collection(circles)
    return axes


def plot_matches(
    points0: np.ndarray,
    points1: np.ndarray,
    inliers: np.ndarray,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    images: tuple[Any, Any],
    axes: Any,
    channels: Channels,
    lines: int,
) -> Any:
    """Plot matches between two images side by side; arguments as of `Matches.plot`."""
    axes = _prepared_axes(axes, list(zip(images, sizes, strict=True)), channels)
    from matplotlib.collections import LineCollection

    chosen = _sample(len(points0), lines)
    chosen = chosen[np.argsort(inliers[chosen], kind="stable")]  # the inliers on top
    ends = np.stack([points0[chosen], points1[chosen] + (sizes[0][0], 0)], axis=1)
    colors = ["lime" if good else "red" for good in inliers[chosen]]
    axes.add_collection(LineCollection(list(ends), colors=colors, linewidths=0.8))
    for end in (0, 1):
        axes.scatter(*ends[:, end].T, s=6, c=colors, linewidths=0)
    return axes


def html_summary(
    title: str,
    rows: Mapping[str, str],
    points: Sequence[Points],
    lines: np.ndarray | None = None,
) -> str:
    """Return a small table in HTML, and a picture of positions, about ten kB.

    Args:
        title: the caption.
        rows: text by name.
        points: positions and (width, height) of one image or two, side by side.
        lines: (M, 2) positions in the first and then in the second image, (M, 4) in all, some of
            which are joined by lines.
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
        for x0, y0, x1, y1 in lines[_sample(len(lines), MAX_LINES)] * scale:
            start, end = (round(x0), round(y0)), (round(x1) + panels[0].shape[1], round(y1))
            cv2.line(picture, start, end, (90, 220, 255))  # smooth ones take five times the bytes
    return picture


def _prepared_axes(
    axes: Any, images: Sequence[tuple[Any, tuple[int, int]]], channels: Channels
) -> Any:
    """Return axes that show images side by side, black ones where there are none."""
    pictures = [_picture(image, size, channels) for image, size in images]
    try:
        from matplotlib import pyplot
    except ImportError:
        raise MissingExtraError(
            "plots need the package matplotlib, which is not installed: run pip install matplotlib"
        ) from None
    height = max(len(picture) for picture in pictures)
    canvas = np.hstack([np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in pictures])
    if axes is None:
        axes = pyplot.subplots(figsize=(6.0 * len(pictures), 4.5), layout="constrained")[1]
    axes.imshow(canvas)
    axes.set_axis_off()
    return axes


def _picture(image: Any, size: tuple[int, int], channels: Channels) -> np.ndarray:
    """Return an image as (H, W, 3) uint8 RGB."""
    if image is None:
        return np.zeros((size[1], size[0], 3), np.uint8)
    if hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        image, channels = np.asarray(image.convert("RGB")), "rgb"
    if isinstance(image, (str, bytes)) or hasattr(image, "__fspath__"):
        raise ImageError("a plot needs the image itself, not a path: give load_image(path)")
    picture = array_to_rgb(image, channels)
    if picture.shape[1::-1] != size:
        raise ImageError(
            f"the image has {picture.shape[1]}x{picture.shape[0]} pixels, the keypoints are of "
            f"one of {size[0]}x{size[1]}: give the image that they were found in"
        )
    return picture


def _sample(count: int, size: int) -> np.ndarray:
    """Choose rows at random, the same ones each time; all where they are few."""
    return np.sort(np.random.default_rng(0).permutation(count)[:size])
