"""Pictures of heat maps, keypoints, matches and labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, OptionError
from .._shared.opencv import cv2
from ..features.keypoints import Keypoints

MAX_CIRCLES = 5000
"""More keypoints than this are drawn as single pixels."""

SUFFIXES = (".png", ".jpg", ".jpeg")
MAX_JPEG_SIDE_PX = 65_500
"""The largest width and height that libjpeg writes."""

CAPTION_HEIGHT = 28
GREEN, RED, WHITE = (60, 255, 60), (255, 60, 60), (255, 255, 255)


def save_picture(rgb: np.ndarray, path: str | Path) -> None:
    """Write a (H, W, 3) uint8 RGB picture, whole or not at all.

    Args:
        rgb: the picture.
        path: ending in .png, .jpg or .jpeg.

    Raises:
        OptionError: the ending is another.
        DeepDetectError: the file cannot be written, or its format holds no picture of this size.
    """
    suffix = picture_suffix(path)
    data = _encode(rgb, suffix)
    if data is None:
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"
        advice = "make it smaller" if suffix == ".png" else "give it a name that ends in .png"
        raise DeepDetectError(f"{path} cannot hold a picture of {size} pixels: {advice}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def picture_suffix(path: str | Path) -> str:
    """Return the suffix of a picture's file in lower case; call it before any expensive work.

    Raises:
        OptionError: `save_picture` does not write such files.

    Example:
        >>> picture_suffix("panorama.JPG")
        '.jpg'
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OptionError(f"{path} must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    return suffix


def _encode(rgb: np.ndarray, suffix: str) -> bytes | None:
    """Return the file's content, or None where the format does not hold such a picture."""
    # Checked before OpenCV is asked, which would also log it.
    if suffix != ".png" and max(rgb.shape[:2]) > MAX_JPEG_SIDE_PX:
        return None
    try:
        done, data = cv2.imencode(suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    except cv2.error:
        return None
    return data.tobytes() if done else None


def draw_heatmap(heatmap: np.ndarray) -> np.ndarray:
    """Colour a (H, W) probability map: dark blue is 0, yellow is 1.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    levels = np.rint(np.clip(heatmap, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def draw_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw keypoints over a dimmed RGB image: as circles when they are few, else as pixels."""
    canvas = rgb // 2
    pixels = np.rint(keypoints.xy).astype(int)
    if len(keypoints) <= MAX_CIRCLES:
        for x, y in pixels.tolist():
            cv2.circle(canvas, (x, y), 3, GREEN, 1, cv2.LINE_AA)
        return canvas
    # Half transparent, so that the image shows through the dense points.
    columns, rows = pixels.T
    canvas[rows, columns] = canvas[rows, columns] // 2 + np.array(GREEN, np.uint8) // 2
    return canvas


def draw_matches(
    rgb0: np.ndarray,
    rgb1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    good: np.ndarray,
    lines: int = 150,
) -> np.ndarray:
    """Draw the two images side by side, with lines between a sample of the matches.

    The lower image is enlarged to the height of the other.

    Args:
        rgb0, rgb1: the images, (H, W, 3) uint8 RGB.
        points0, points1: (M, 2) matched positions.
        good: (M,) bool: green lines, the others red.
        lines: number of lines; the sample is random with a fixed seed, so green and red
            have the proportions of all matches.

    Returns:
        (H, W, 3) uint8 RGB, H that of the taller image, W that of both at this height.
    """
    height = max(rgb0.shape[0], rgb1.shape[0])
    shown = [_of_height(rgb, height) for rgb in (rgb0, rgb1)]
    canvas = cv2.convertScaleAbs(np.concatenate(shown, axis=1), alpha=0.7)
    points0, points1 = (
        (np.asarray(points, np.float64) + 0.5) * (view.shape[1] / rgb.shape[1], height / len(rgb))
        - 0.5
        for points, view, rgb in zip((points0, points1), shown, (rgb0, rgb1), strict=True)
    )
    chosen = np.random.default_rng(0).permutation(len(points0))[:lines]
    for k in sorted(chosen, key=lambda k: bool(good[k])):  # the good ones on top
        start = tuple(int(v) for v in np.rint(points0[k]))
        end = tuple(int(v) for v in np.rint(points1[k] + [shown[0].shape[1], 0]))
        colour = GREEN if good[k] else RED
        cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start, 2, colour, -1, cv2.LINE_AA)
        cv2.circle(canvas, end, 2, colour, -1, cv2.LINE_AA)
    return canvas


def _of_height(rgb: np.ndarray, height: int) -> np.ndarray:
    """Enlarge an image to a height."""
    if len(rgb) == height:
        return rgb
    width = max(1, round(rgb.shape[1] * height / len(rgb)))
    return cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR)


def draw_masks(rgb: np.ndarray, masks: Mapping[str, np.ndarray], title: str) -> np.ndarray:
    """Draw an image and masks of it in a row.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        masks: (H, W) bool masks by title.
        title: the caption of the image.

    Returns:
        One panel for the image and one per mask, each mask captioned with its density.
    """
    panels = [add_caption(rgb, title)]
    for name, mask in masks.items():
        picture = np.repeat((mask * np.uint8(255))[:, :, None], 3, 2)
        panels.append(add_caption(picture, f"{name}: {mask.mean():.1%} of pixels"))
    return hstack(panels)


def add_caption(rgb: np.ndarray, text: str) -> np.ndarray:
    """Add a line of text below a picture, scaled down to fit its width."""
    strip = np.zeros((CAPTION_HEIGHT, rgb.shape[1], 3), np.uint8)
    scale = 0.5
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    scale *= min(1.0, (rgb.shape[1] - 12) / max(width, 1))
    cv2.putText(strip, text, (6, 19), cv2.FONT_HERSHEY_SIMPLEX, scale, WHITE, 1, cv2.LINE_AA)
    return np.concatenate([rgb, strip])


def hstack(panels: Sequence[np.ndarray], gap: int = 6) -> np.ndarray:
    """Join pictures from left to right, with a white gap, and black below lower ones."""
    height = max(panel.shape[0] for panel in panels)
    joined: list[np.ndarray] = []
    for panel in panels:
        if joined:
            joined.append(np.full((height, gap, 3), 255, np.uint8))
        joined.append(np.pad(panel, ((0, height - panel.shape[0]), (0, 0), (0, 0))))
    return np.concatenate(joined, axis=1)


def vstack(rows: Sequence[np.ndarray], gap: int = 6) -> np.ndarray:
    """Join pictures from top to bottom, with a white gap, and white beside narrower ones."""
    width = max(row.shape[1] for row in rows)
    joined: list[np.ndarray] = []
    for row in rows:
        if joined:
            joined.append(np.full((gap, width, 3), 255, np.uint8))
        padding = ((0, 0), (0, width - row.shape[1]), (0, 0))
        joined.append(np.pad(row, padding, constant_values=255))
    return np.concatenate(joined)
