"""Depth maps in files: 16-bit PNG that carries its scale, and npz with floats."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, PngImagePlugin

from .._shared.atomic import atomic_path
from .._shared.errors import ImageError, OptionError, unknown_name
from ..geometry.point_cloud import UNITS
from .image_file import MAX_MEGAPIXELS, file_name, open_image

MAX_UINT16 = 65535

HEADROOM = 4.0
"""The default scale holds all depths up to this many times their 99th percentile."""


@dataclass(frozen=True)
class DepthPng:
    """How a depth map was stored in 16 bits.

    Attributes:
        unit: "mm" or "baseline".
        value_per_unit: depth = value / value_per_unit; a value of 0 is unknown.
        known: pixels with a value.
        out_of_range: pixels whose depth 16 bits at this scale cannot hold; they are written
            as unknown, never as another depth.
    """

    unit: str
    value_per_unit: float
    known: int
    out_of_range: int


def save_depth_png(
    depth: np.ndarray, path: str | Path, unit: str, value_per_unit: float | None = None
) -> DepthPng:
    """Write a depth map as a grey PNG of 16 bits, whole or not at all.

    value = round(depth * value_per_unit), and 0 where the depth is unknown. Unit and scale
    are also written into the PNG, as text chunks `unit` and `value_per_unit`.

    Args:
        depth: (H, W) depths; not finite, 0 or less: unknown.
        path: ending in .png.
        unit: "mm" or "baseline" (multiples of the distance of the two cameras).
        value_per_unit: the scale; by default the finest of 1, 2 or 5 times a power of ten
            that holds all depths up to 4 times the 99th percentile.

    Returns:
        The scale, and the numbers of pixels.

    Raises:
        OptionError: the map is no (H, W) array, the unit is unknown, the scale is not above 0
            or the suffix is wrong.
        DeepDetectError: the file cannot be written.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "depth.png"
        >>> save_depth_png(np.array([[500.25, np.nan, 3000.0]]), path, "mm")
        DepthPng(unit='mm', value_per_unit=20.0, known=2, out_of_range=0)
        >>> load_depth_png(path)[0].tolist()
        [[500.25, nan, 3000.0]]
    """
    depth = _checked(depth, unit)
    if Path(path).suffix.lower() != ".png":
        raise OptionError(f"{path} must end in .png")
    if value_per_unit is not None and not 0 < value_per_unit < np.inf:
        raise OptionError(f"value_per_unit must be above 0, not {value_per_unit}")
    known = np.isfinite(depth) & (depth > 0)
    scale = float(value_per_unit or _scale(depth[known]))
    values = np.rint(np.where(known, depth, 0).astype(np.float64) * scale)
    fits = known & (values >= 1) & (values <= MAX_UINT16)
    stored = np.where(fits, values, 0).astype(np.uint16)
    chunks = PngImagePlugin.PngInfo()
    chunks.add_text("unit", unit)
    chunks.add_text("value_per_unit", repr(scale))
    with atomic_path(path) as temporary:
        Image.fromarray(stored).save(temporary, format="PNG", pnginfo=chunks)
    return DepthPng(unit, scale, int(fits.sum()), int((known & ~fits).sum()))


def load_depth_png(
    source: Any, *, max_megapixels: float = MAX_MEGAPIXELS
) -> tuple[np.ndarray, str]:
    """Read a depth map that `save_depth_png` wrote.

    Args:
        source: a path, the content of a file as bytes, or an open binary file.
        max_megapixels: larger files are refused before they are decoded.

    Returns:
        (H, W) float32 depths, NaN where unknown, and their unit.

    Raises:
        ImageError: the file is missing, damaged, too large, or is no such depth map.
    """
    with open_image(source, what="depth map", max_megapixels=max_megapixels) as image:
        scale, unit = _scale_and_unit(image, file_name(source, "depth map"))
        values = np.asarray(image)
    return np.where(values == 0, np.nan, values / scale).astype(np.float32), unit


def _scale_and_unit(image: Any, name: str) -> tuple[float, str]:
    """Return what `save_depth_png` wrote beside the pixels."""
    try:
        scale, unit = float(image.info["value_per_unit"]), str(image.info["unit"])
    except (KeyError, TypeError, ValueError):
        raise ImageError(
            f"{name} is no depth map that carries its scale and unit: take one that "
            "save_depth_png wrote"
        ) from None
    wrong = ""
    if not (image.mode == "I" or image.mode.startswith("I;16")):
        wrong = f"its pixels are {image.mode} instead of 16-bit grey"
    elif not 0 < scale < np.inf:
        wrong = f"value_per_unit is {scale:g} instead of a number above 0"
    elif unit not in UNITS:
        wrong = f"its unit is {unit[:40]!r} instead of one of {', '.join(UNITS)}"
    if wrong:
        raise ImageError(f"{name} is no depth map that can be used, {wrong}: write it again")
    return scale, unit


def save_depth_npz(depth: np.ndarray, path: str | Path, unit: str, **arrays: np.ndarray) -> None:
    """Write a depth map as floats, whole or not at all.

    Args:
        depth: (H, W) depths; not finite, 0 or less: unknown, written as NaN.
        path: ending in .npz; it gets `depth` (H, W) float32 and `unit`.
        unit: "mm" or "baseline".
        **arrays: further arrays, as `disparity`.

    Raises:
        OptionError: the map is no (H, W) array, the unit is unknown, or the suffix is wrong.
        DeepDetectError: the file cannot be written.
    """
    depth = _checked(depth, unit)
    if Path(path).suffix.lower() != ".npz":
        raise OptionError(f"{path} must end in .npz")
    known = np.isfinite(depth) & (depth > 0)
    stored = np.where(known, depth, np.nan).astype(np.float32)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, depth=stored, unit=np.array(unit), **arrays)  # type: ignore[arg-type]


def _checked(depth: Any, unit: str) -> np.ndarray:
    depth = np.asarray(depth)
    if depth.ndim != 2 or depth.size == 0 or depth.dtype.kind not in "fiu":
        raise OptionError(
            f"a depth map must be an (H, W) array of numbers, not {depth.dtype} of {depth.shape}"
        )
    if unit not in UNITS:
        raise unknown_name("unit", unit, UNITS)
    return depth


def _scale(depths: np.ndarray) -> float:
    """Choose the finest round scale that holds all depths but outliers."""
    if not len(depths):
        return 1.0
    furthest = min(float(depths.max()), HEADROOM * float(np.percentile(depths, 99)))
    finest = MAX_UINT16 / furthest
    power = 10.0 ** np.floor(np.log10(finest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= finest * (1 + 1e-12)))
