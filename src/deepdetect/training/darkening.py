"""Darkening of photographs: reduced brightness, then reduced contrast (paper, Section III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .._shared.errors import OptionError


@dataclass(frozen=True)
class Darkening:
    """Two factors in (0, 1], as of Pillow's `ImageEnhance.Brightness` and `.Contrast`.

    The published dark images fit brightness 0.3 and contrast 0.4.
    """

    brightness: float
    contrast: float

    def __post_init__(self) -> None:
        for name in ("brightness", "contrast"):
            if not 0 < getattr(self, name) <= 1:
                raise OptionError(f"{name} must be above 0 and at most 1")


@dataclass(frozen=True)
class DarkeningRange:
    """Ranges that the factors are drawn from.

    The product stays under 0.25, so that a darkened image spans fewer than the 64
    grey levels under which an image counts as of low visibility.
    """

    brightness: tuple[float, float] = (0.2, 0.45)
    contrast: tuple[float, float] = (0.3, 0.55)

    def draw(self, generator: np.random.Generator) -> Darkening:
        """Draw both factors, rounded to thousandths so that they can be named in a file."""
        return Darkening(
            round(float(generator.uniform(*self.brightness)), 3),
            round(float(generator.uniform(*self.contrast)), 3),
        )


def darken(rgb: np.ndarray, darkening: Darkening) -> np.ndarray:
    """Reduce the brightness, then pull all values towards the mean luma.

    Args:
        rgb: (H, W, 3) uint8.
        darkening: the two factors.

    Returns:
        (H, W, 3) uint8, equal to what Pillow's `ImageEnhance` gives.

    Example:
        >>> int(darken(np.full((16, 16, 3), 200, np.uint8), Darkening(0.3, 0.4))[0, 0, 0])
        60
    """
    # One value depends on itself and the mean only, so two tables of 256 entries do it all.
    # Pillow blends in float32 and truncates.
    levels = np.arange(256, dtype=np.float32)
    dimmed = (levels * np.float32(darkening.brightness)).astype(np.uint8)
    dark = cv2.LUT(rgb, dimmed)
    mean = np.float32(int(_pillow_luma(dark).mean() + 0.5))
    flattened = (mean + (levels - mean) * np.float32(darkening.contrast)).astype(np.uint8)
    return cv2.LUT(dark, flattened)


def _pillow_luma(rgb: np.ndarray) -> np.ndarray:
    """Return Pillow's luma; for one colour in 800 it differs from OpenCV's by one level."""
    # Whole numbers up to 2 ** 24, which float32 holds exactly.
    weights = np.array([[19595, 38470, 7471, 0x8000]], np.float32)
    return cv2.transform(rgb.astype(np.float32), weights).astype(np.uint32) >> 16
