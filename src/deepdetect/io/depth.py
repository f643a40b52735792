"""Depth maps in files: 16-bit PNG with its scale in the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, PngImagePlugin

from .._shared.atomic import atomic_path

MAX_UINT16 = 65535

HEADROOM = 4.0
"""A PNG stores depths up to this many times their 99th percentile. If it also stored outliers
beyond this limit, its depth steps would be coarse."""


def save_depth_png(
    depth: np.ndarray, path: Path, unit: str, scale: float | None = None
) -> dict[str, str | float]:
    """Write a depth map as a 16-bit grey PNG, atomically; return a summary of its content.

    A pixel is round(depth * value_per_unit), or 0 if the depth is unknown (not finite, 0 or less).
    `value_per_unit` is `scale`. By default it is the largest number 1, 2 or 5 times a power of ten
    with which 16 bits cover all depths up to 4 times the 99th percentile. Other depths are written
    as unknown and counted as `out_of_range`. The PNG has text chunks `unit` and `value_per_unit`.
    """
    known = np.isfinite(depth) & (depth > 0)
    scale = scale or _scale(depth[known])
    values = np.rint(np.where(known, depth, 0).astype(np.float64) * scale)
    fits = known & (values >= 1) & (values <= MAX_UINT16)
    stored = np.where(fits, values, 0).astype(np.uint16)
    chunks = PngImagePlugin.PngInfo()
    chunks.add_text("unit", unit)
    chunks.add_text("value_per_unit", repr(scale))
    with atomic_path(path) as temporary:
        Image.fromarray(stored).save(temporary, format="PNG", pnginfo=chunks)
    return {
        "unit": unit,
        "value_per_unit": scale,
        "unknown": 0,
        "known_pixels": int(fits.sum()),
        "out_of_range": int((known & ~fits).sum()),
    }


def _scale(depths: np.ndarray) -> float:
    if not len(depths):
        return 1.0
    return depth_scale(min(float(depths.max()), HEADROOM * float(np.percentile(depths, 99))))


def depth_scale(furthest: float) -> float:
    """Return the largest scale, 1, 2 or 5 times a power of ten, that fits a depth into 16 bits."""
    finest = MAX_UINT16 / furthest
    power = 10.0 ** np.floor(np.log10(finest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= finest * (1 + 1e-12)))
