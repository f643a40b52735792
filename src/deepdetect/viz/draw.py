"""Pictures of heat maps, keypoints, matches and labels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, OptionError
from .._shared.image_array import to_8_bits
from .._shared.opencv import cv2
from ..features.display import PICTURE_SIDE_PX, draw_circle, line_scale
from ..features.keypoints import Keypoints
from ..features.selection import spread_over_grid
from ..geometry.transforms import scaled_points
from ..io.metadata import Metadata

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_JPEG_SIDE_PX = 65_500
"""The largest width and height that libjpeg writes."""

JPEG_QUALITY = 85
SHOWN_KEYPOINTS = 1000
AREA_OF_KEYPOINT_PX = 200
"""Pixels of a small picture for each keypoint that is drawn, so that all can be told apart."""

SHOWN_PERCENTILE = 99.0
"""Values above it, and below the opposite one, have the last colours: few may be far away."""

LEAST_LEVEL, LEAST_DEPTH_LEVEL = 0.35, 0.2
"""Darker colours of the scale are not seen on a photograph, or look like unknown depth."""

CAPTION_HEIGHT = 28
"""Of pictures that are not wider than `READABLE_WIDTH_PX`."""

CAPTION_MARGIN = 6
"""To the left and to the right of the text, as `CAPTION_HEIGHT`."""

CAPTION_SCALE = 0.5
GAP_PX = 6
"""Between pictures that are joined."""

WHITE = (255, 255, 255)


def save_picture(rgb: np.ndarray, path: str | Path, metadata: Metadata = Metadata()) -> None:
    """Write a (H, W, 3) uint8 or uint16 RGB picture as .png or .tif, or of 8 bits as .jpg.

    It is written whole or not at all.
    """
    suffix = picture_suffix(path)
    if suffix.startswith(".tif"):
        metadata.write_tiff(rgb, Path(path))
        return
    # Checked before OpenCV is asked, which would also log it.
    if suffix != ".png" and max(rgb.shape[:2]) > MAX_JPEG_SIDE_PX:
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"
        raise DeepDetectError(
            f"{path} cannot hold a picture of {size} pixels: give it a name that ends in .png"
        )
    settings = []
    if suffix != ".png":
        rgb, settings = to_8_bits(rgb), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    data = metadata.encode(rgb, suffix, settings)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def picture_suffix(path: str | Path) -> str:
    """Return the suffix of a picture's file in lower case; call it before any expensive work."""
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OptionError(f"{path} must end in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}")
    return suffix


def draw_heatmap(heatmap: np.ndarray) -> np.ndarray:
    """Colour a (H, W) probability map, as (H, W, 3) uint8: dark blue is 0, yellow is 1."""
    levels = np.rint(np.clip(heatmap, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB)


def draw_logits(logits: np.ndarray) -> np.ndarray:
    """Colour a (H, W) map of logits, with a scale below it: 0 is a probability of one half.

    Of probabilities most would be the darkest or the brightest colour: a sixth of the pixels of a
    photograph have one that float32 rounds to 1.
    """
    shown = fit_picture(np.asarray(logits, np.float32))
    known = np.where(np.isfinite(shown), shown, 0)
    low, high = _shown_range(known)
    low, high = min(low, -1.0), max(high, 1.0)
    levels = np.where(np.isfinite(shown), (known - low) / (high - low), shown > 0)
    words = "logit of a keypoint, 0 is a probability of 0.5"
    return add_scale(draw_heatmap(levels), words, low, high)


def draw_depth(depth: np.ndarray, unit: str) -> np.ndarray:
    """Colour a (H, W) depth map, NaN where unknown, with a scale, as `fit_picture` sizes it.

    Yellow is near, dark blue far, black unknown.
    """
    known = np.isfinite(depth)
    if not known.any():
        return add_caption(np.zeros((*depth.shape, 3), np.uint8), "no depth is known")
    near, far = _shown_range(depth[known])
    # By inverse depth, as differences are seen.
    inverse = 1 / np.maximum(np.where(known, depth, far), 1e-9)
    levels = (inverse - 1 / far) / max(1 / near - 1 / far, 1e-12)
    colors = draw_heatmap(LEAST_DEPTH_LEVEL + (1 - LEAST_DEPTH_LEVEL) * np.clip(levels, 0, 1))
    # A point is more than a pixel, so that few of them are seen, too.
    spread = cv2.dilate(np.where(known[..., None], colors, 0).astype(np.uint8), np.ones((3, 3)))
    colors = np.where(known[..., None], colors, spread)
    words = f"depth in {'baselines' if unit == 'baseline' else unit}, black: unknown"
    return add_scale(fit_picture(colors), words, far, near, LEAST_DEPTH_LEVEL)


def draw_best_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw the best keypoints of all parts of an image, coloured by score or logit, with a scale.

    At most `SHOWN_KEYPOINTS`, fewer on small images: in turn the best of each cell of a grid. They
    are circles of their size, or all alike where they have none. `fit_picture` sizes the picture.
    """
    shown = fit_picture(rgb)
    factor = shown.shape[1] / rgb.shape[1]
    # A grey, darker copy, on which colours are seen.
    gray = cv2.convertScaleAbs(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), alpha=0.6)
    canvas = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
    values = keypoints.scores if keypoints.logits is None else keypoints.logits
    name = "score" if keypoints.logits is None else "logit"
    unit = line_scale(canvas)
    room = int(canvas.shape[0] * canvas.shape[1] / (AREA_OF_KEYPOINT_PX * unit**2))
    most = max(1, min(SHOWN_KEYPOINTS, room, len(keypoints)))
    # No more cells than keypoints, or the dimmest parts would be left out.
    shorter, longer = sorted(canvas.shape[:2])
    cells = max(1, int((most * longer / shorter) ** 0.5))
    rows = spread_over_grid(keypoints.xy, values, keypoints.image_size, most, cells)
    counted = f"{len(rows):,} of " if len(rows) < len(keypoints) else ""
    counted += _counted(keypoints)
    if not len(rows):
        return add_caption(canvas, "no keypoints")
    low, high = _shown_range(values[rows])
    levels = np.clip((values[rows] - low) / max(high - low, 1e-9), 0, 1)
    colors = _viridis(LEAST_LEVEL + (1 - LEAST_LEVEL) * levels).tolist()
    radii = np.full(len(rows), 3 * unit)
    if keypoints.sizes is not None:
        radii = np.maximum(keypoints.sizes[rows] * factor / 2, 2 * unit)
    centres = scaled_points(keypoints.xy[rows], factor)
    # The best on top, and a dark rim, so that each is seen before any colour.
    for k in np.argsort(values[rows]):
        draw_circle(canvas, centres[k], radii[k], (0, 0, 0), max(2, round(2.5 * unit)))
        draw_circle(canvas, centres[k], radii[k], colors[k], max(1, round(1.25 * unit)))
    return add_scale(canvas, f"{counted}, coloured by {name}", low, high, LEAST_LEVEL)


def draw_dense_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw all keypoints, with a caption that counts them, as `fit_picture` sizes it."""
    caption = f"{_counted(keypoints)}, {keypoints.density:.1%} of the pixels"
    return add_caption(fit_picture(keypoints.draw(rgb)), caption)


def _counted(keypoints: Keypoints) -> str:
    return f"{len(keypoints):,} keypoint{'' if len(keypoints) == 1 else 's'}"


def _shown_range(values: np.ndarray) -> tuple[float, float]:
    """Return the values that have the last colours."""
    low, high = np.percentile(values, (100 - SHOWN_PERCENTILE, SHOWN_PERCENTILE))
    return float(low), float(high)


def fit_picture(picture: np.ndarray) -> np.ndarray:
    """Scale a picture or a map down so that its longer side is at most `PICTURE_SIDE_PX`."""
    height, width = picture.shape[:2]
    factor = PICTURE_SIDE_PX / max(height, width)
    if factor >= 1:
        return picture
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _viridis(levels: np.ndarray) -> np.ndarray:
    colors: np.ndarray = draw_heatmap(np.asarray(levels).reshape(1, -1))[0]
    return colors


def add_caption(rgb: np.ndarray, text: str) -> np.ndarray:
    """Add a line of text below a picture, scaled to be legible and to fit its width."""
    return np.concatenate([rgb, _caption(text, rgb.shape[1], line_scale(rgb))])


def add_scale(
    rgb: np.ndarray, text: str, low: float, high: float, least_level: float = 0.0
) -> np.ndarray:
    """Add a line of text below a picture, and the colours of values from `low` to `high`.

    The colours are those of `draw_heatmap` from `least_level` to 1. The values are at their ends,
    with as many decimals as tell apart a tenth of the scale.
    """
    width, unit = rgb.shape[1], line_scale(rgb)
    bar, end = max(1, width // 5), width // 7
    decimals = max(0, 1 - math.floor(math.log10(abs(high - low) or abs(high) or 1)))
    left, right = (_caption(f"{value:,.{decimals}f}", end, unit) for value in (low, high))
    strip = _caption(text, width - bar - 2 * end, unit)
    gap = len(strip) // 4
    colors = np.zeros((len(strip), bar, 3), np.uint8)
    colors[gap : len(strip) - gap] = _viridis(np.linspace(least_level, 1, bar))
    return np.concatenate([rgb, np.concatenate([strip, left, colors, right], axis=1)])


def _caption(text: str, width: int, unit: float) -> np.ndarray:
    """Return a black strip with a line of text that fits it; `unit` is that of `line_scale`."""
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


def join_pictures(panels: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Join pictures of one size, this many in a row, with white gaps between them."""
    height, width = panels[0].shape[:2]
    rows = -(-len(panels) // columns)
    size = rows * (height + GAP_PX) - GAP_PX, columns * (width + GAP_PX) - GAP_PX, 3
    joined = np.full(size, 255, np.uint8)
    for k, panel in enumerate(panels):
        top, left = k // columns * (height + GAP_PX), k % columns * (width + GAP_PX)
        joined[top : top + height, left : left + width] = panel
    return joined
