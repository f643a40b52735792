"""Pictures of keypoints, matches, heat maps and depth maps, drawn from arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .._shared.opencv import cv2

MAX_CIRCLES, LEAST_RADIUS_PX = 5000, 2.0
"""More than MAX_CIRCLES keypoints are drawn as single pixels, since circles would cover the image.
A circle has at least the radius LEAST_RADIUS_PX, or 1 pixel more if its keypoint has no size."""

PICTURE_SIDE_PX = 2000
"""Longest side of a visualisation, in pixels, so that its JPEG takes less than two megabytes."""

READABLE_WIDTH_PX = 800
"""Captions, lines and points grow with the width of images wider than this. Chosen by hand."""

LINES, DOTS = 60, 1500
"""If colours encode positions, at most `DOTS` matches are drawn as pairs of points, and only
`LINES` of the pairs are joined by a line. Chosen by hand."""

SHOWN_PERCENTILE = 99.0
"""Colour scales span the 1st to this percentile, so that outliers do not matter. Chosen by hand."""

LEAST_DEPTH_LEVEL = 0.2
"""The farthest depth has this level (0 to 1) of the colour scale, because darker colours look like
the black of unknown depth. Chosen by hand."""

CAPTION_HEIGHT, CAPTION_MARGIN, CAPTION_SCALE = 28, 6, 0.5
"""Height and side margin of a caption, in pixels, and its font scale in OpenCV, for images up to
`READABLE_WIDTH_PX` wide. Chosen by hand so that captions are legible."""

GREEN, RED, WHITE = (60, 255, 60), (255, 60, 60), (255, 255, 255)


def draw_keypoints(rgb: np.ndarray, xy: np.ndarray, sizes: np.ndarray | None) -> np.ndarray:
    """Draw keypoints on a dimmed copy of an (H, W, 3) uint8 RGB image, for `Keypoints.draw`."""
    canvas, unit = rgb // 2, line_scale(rgb)
    if len(xy) > MAX_CIRCLES:
        # Half transparent, so that the image stays visible below dense keypoints.
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
    """Draw two images side by side, with lines that join the points of a random sample of matches.

    The image with the smaller height is enlarged to the height of the other. Both are then reduced
    if the result exceeds `PICTURE_SIDE_PX`. Matches that are `good` are green, others red. With
    `by_position`, the colour of good matches encodes their position in the first image, and most
    matches are drawn without a line.
    """
    height = max(rgb0.shape[0], rgb1.shape[0])
    width = sum(rgb.shape[1] * height / len(rgb) for rgb in (rgb0, rgb1))
    height = max(1, round(height * min(1.0, PICTURE_SIDE_PX / max(width, height))))
    shown = [resized(rgb, height / len(rgb)) for rgb in (rgb0, rgb1)]
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
    for k in np.argsort(good[order], kind="stable"):  # draws good matches last, on top
        row, color = order[k], colors[k].tolist()
        start = np.rint(points0[row]).astype(int).tolist()
        end = np.rint(points1[row] + [shown[0].shape[1], 0]).astype(int).tolist()
        if with_line[k]:
            cv2.line(canvas, start, end, color, round(unit), cv2.LINE_AA)
        for point in (start, end):
            cv2.circle(canvas, point, round(2 * unit), color, -1, cv2.LINE_AA)
    return canvas


def _colors_of_positions(positions: np.ndarray) -> np.ndarray:
    """Return (N, 3) RGB colours of (N, 2) positions in [0, 1]: hue encodes x, darkness encodes y.

    Red is not used, since it marks matches that are not good.
    """
    x, y = np.clip(positions, 0, 1).T
    # OpenCV's hue is in [0, 180), saturation and value are in [0, 255].
    hsv = np.rint(np.stack([20 + 120 * x, np.full(len(x), 230), 255 - 110 * y], 1))
    return cv2.cvtColor(hsv.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0] if len(x) else hsv


def draw_circle(
    canvas: np.ndarray, centre: np.ndarray, radius: float, color: Sequence[int], width: int
) -> None:
    """Draw a circle; its centre (x, y) and radius, in pixels, are rounded to sixteenths."""
    x, y = np.rint(centre * 16).astype(int).tolist()
    cv2.circle(canvas, (x, y), round(radius * 16), tuple(color), width, cv2.LINE_AA, 4)


def draw_heatmap(heatmap: np.ndarray) -> np.ndarray:
    """Colour an (H, W) probability map as (H, W, 3) uint8 RGB: dark blue is 0, yellow is 1."""
    levels = np.rint(np.clip(heatmap, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def draw_logits(logits: np.ndarray) -> np.ndarray:
    """Colour an (H, W) map of logits, with a colour scale below it.

    A logit of 0 is a probability of 0.5. A map of probabilities would saturate: in a photograph,
    float32 rounds the probabilities of about a sixth of the pixels to 1.
    """
    shown = fit_picture(np.asarray(logits, np.float32))
    known = np.where(np.isfinite(shown), shown, 0)
    low, high = shown_range(known)
    low, high = min(low, -1.0), max(high, 1.0)
    levels = np.where(np.isfinite(shown), (known - low) / (high - low), shown > 0)
    words = "logit of a keypoint; 0 is a probability of 0.5"
    return add_scale(draw_heatmap(levels), words, low, high)


def draw_depth(depth: np.ndarray, unit: str) -> np.ndarray:
    """Colour an (H, W) depth map, with a colour scale below it, and reduce it by `fit_picture`.

    Yellow is near, dark blue is far. Unknown depth, given as NaN, is black.
    """
    known = np.isfinite(depth)
    if not known.any():
        return add_caption(np.zeros((*depth.shape, 3), np.uint8), "no depth is known")
    near, far = shown_range(depth[known])
    # Colours are linear in inverse depth, as in a map of disparities.
    inverse = 1 / np.maximum(np.where(known, depth, far), 1e-9)
    levels = (inverse - 1 / far) / max(1 / near - 1 / far, 1e-12)
    colors = draw_heatmap(LEAST_DEPTH_LEVEL + (1 - LEAST_DEPTH_LEVEL) * np.clip(levels, 0, 1))
    # Each known pixel is enlarged to 3x3, so that sparse depth is visible.
    spread = cv2.dilate(np.where(known[..., None], colors, 0).astype(np.uint8), np.ones((3, 3)))
    colors = np.where(known[..., None], colors, spread)
    words = f"depth in {'baselines' if unit == 'baseline' else unit}, black: unknown"
    return add_scale(fit_picture(colors), words, far, near, LEAST_DEPTH_LEVEL)


def shown_range(values: np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest value on the colour scale (see `SHOWN_PERCENTILE`)."""
    low, high = np.percentile(values, (100 - SHOWN_PERCENTILE, SHOWN_PERCENTILE))
    return float(low), float(high)


def viridis(levels: np.ndarray) -> np.ndarray:
    """Return the (N, 3) RGB colours that `draw_heatmap` gives to (N,) levels in [0, 1]."""
    return np.asarray(draw_heatmap(np.asarray(levels).reshape(1, -1))[0])


def line_scale(picture: np.ndarray) -> float:
    """Return the factor by which captions, lines and points are enlarged on this image."""
    return max(1.0, picture.shape[1] / READABLE_WIDTH_PX)


def resized(picture: np.ndarray, factor: float) -> np.ndarray:
    """Scale an image or a map by a factor; if it shrinks, area averaging avoids aliasing."""
    size = [max(1, round(side * factor)) for side in picture.shape[1::-1]]
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    return cv2.resize(picture, size, interpolation=method)


def fit_picture(picture: np.ndarray) -> np.ndarray:
    """Scale an image or a map down so that its longer side is at most `PICTURE_SIDE_PX`."""
    factor = PICTURE_SIDE_PX / max(picture.shape[:2])
    return picture if factor >= 1 else resized(picture, factor)


def add_caption(rgb: np.ndarray, text: str) -> np.ndarray:
    """Add a line of text below an image, scaled to be legible and to fit its width."""
    return np.concatenate([rgb, _caption(text, rgb.shape[1], line_scale(rgb))])


def add_scale(
    rgb: np.ndarray, text: str, low: float, high: float, least_level: float = 0.0
) -> np.ndarray:
    """Add a line of text and a colour scale from `low` to `high` below an image.

    The scale shows the colours of `draw_heatmap` from `least_level` to 1. The values at its ends
    have enough decimals to distinguish a tenth of the scale.
    """
    width, unit = rgb.shape[1], line_scale(rgb)
    bar, end = max(1, width // 5), width // 7
    decimals = max(0, 1 - math.floor(math.log10(abs(high - low) or abs(high) or 1)))
    left, right = (_caption(f"{value:,.{decimals}f}", end, unit) for value in (low, high))
    strip = _caption(text, width - bar - 2 * end, unit)
    gap = len(strip) // 4
    colors = np.zeros((len(strip), bar, 3), np.uint8)
    colors[gap : len(strip) - gap] = viridis(np.linspace(least_level, 1, bar))
    return np.concatenate([rgb, np.concatenate([strip, left, colors, right], axis=1)])


def _caption(text: str, width: int, unit: float) -> np.ndarray:
    """Return a black strip with one line of text, shrunk to fit; `unit` comes from `line_scale`."""
    strip = np.zeros((round(CAPTION_HEIGHT * unit), width, 3), np.uint8)
    room = width - round(2 * CAPTION_MARGIN * unit)
    if room <= 0:
        return strip
    place, font = (round(CAPTION_MARGIN * unit), round(19 * unit)), cv2.FONT_HERSHEY_SIMPLEX
    scale, thickness = CAPTION_SCALE * unit, max(1, round(unit))
    (long, _), _ = cv2.getTextSize(text, font, scale, thickness)
    scale *= min(1.0, room / max(long, 1))
    cv2.putText(strip, text, place, font, scale, WHITE, thickness, cv2.LINE_AA)
    return strip
