"""Changes of a crop and its label: mirrors, and colours of the same luma."""

from __future__ import annotations

import math

import cv2
import numpy as np

from ..io.image import luma

RED, GREEN, BLUE = 0.299, 0.587, 0.114  # of the luma (BT.601)


def flip(image: np.ndarray, mask: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Mirror a crop left to right (axis 1) or upside down (axis 0).

    The label of a mirrored photograph is another one: some detectors have filters of even width, or
    look for corners at even pixels of a smaller image (docs/training.md).
    """
    # Copies a hundred times faster than a negative stride.
    return cv2.flip(image, axis), cv2.flip(mask.view(np.uint8), axis).view(bool)


def transpose(image: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mirror a crop along its diagonal: all detectors but BRISK mark the same pixels."""
    return cv2.transpose(image), cv2.transpose(mask.view(np.uint8)).view(bool)


def without_color(rgb: np.ndarray) -> np.ndarray:
    """Replace an image's colours by its luma, from which labels are made: they stay the same.

    Args:
        rgb: (H, W, 3) uint8 RGB.

    Example:
        >>> without_color(np.full((1, 1, 3), (200, 100, 50), np.uint8)).tolist()
        [[[124, 124, 124]]]
    """
    return cv2.cvtColor(luma(rgb), cv2.COLOR_GRAY2RGB)


def turn_hue(rgb: np.ndarray, angle: float, saturation: float) -> np.ndarray:
    """Turn the colours around the luma, which changes by rounding only.

    Args:
        rgb: (H, W, 3) uint8 RGB.
        angle: in radians, in the plane of B - Y and R - Y.
        saturation: factor of the colours; where they would leave the range of the values, they
            are faded until they do not.

    Returns:
        (H, W, 3) uint8 RGB, whose luma differs by at most one level.
    """
    red, green, blue = cv2.split(rgb.astype(np.float32))
    gray = RED * red + GREEN * green + BLUE * blue
    # The two differences have these ranges, so that the turn is one of Cb and Cr.
    wide_blue, wide_red = 1 - BLUE, 1 - RED
    blue, red = (blue - gray) / wide_blue, (red - gray) / wide_red
    cosine, sine = saturation * math.cos(angle), saturation * math.sin(angle)
    blue, red = wide_blue * (cosine * blue - sine * red), wide_red * (sine * blue + cosine * red)
    green = -(RED * red + BLUE * blue) / GREEN
    # How far each pixel goes beyond white or black, as a multiple of the room that it has.
    above = np.maximum(np.maximum(red, green), blue) / np.maximum(255 - gray, 1e-6)
    below = np.minimum(np.minimum(red, green), blue) / np.minimum(-gray, -1e-6)
    share = 1 / np.maximum(np.maximum(above, below), 1)
    turned = cv2.merge([gray + share * plane for plane in (red, green, blue)])
    return cv2.convertScaleAbs(turned)
