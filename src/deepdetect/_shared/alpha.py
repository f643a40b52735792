"""Transparent pixels: they are filled with grey, and a fourth channel of the image marks them.

Inside the package, an image with transparent pixels has a fourth channel. It is 0 at transparent
pixels, and the largest value of its data type at all others.
"""

from __future__ import annotations

import warnings

import numpy as np

from .opencv import cv2


def on_grey(
    rgb: np.ndarray, alpha: np.ndarray, opaque: float, name: str, *, associated: bool = False
) -> np.ndarray:
    """Blend an (H, W, 3) uint8 or uint16 image with grey by its (H, W) alpha, from 0 to `opaque`.

    If `associated`, the colours are already multiplied by alpha. Pixels with alpha below half of
    `opaque` count as transparent, and the fourth channel of the result marks them.
    """
    if (alpha >= opaque).all():
        return rgb
    hidden = alpha < opaque / 2
    if hidden.all():
        left_out = f"{name} is transparent everywhere: its alpha channel is left out"
        warnings.warn(left_out, UserWarning, stacklevel=2)
        return rgb
    top = int(np.iinfo(rgb.dtype).max)
    ground = top // 2 + 1  # mid-grey differs least from most images
    filled = np.full((*rgb.shape[:2], 4), top, rgb.dtype)
    for row, colours in enumerate(rgb):
        share = np.divide(alpha[row, :, None], opaque, dtype=np.float64).clip(0, 1)
        mixed = colours * (1.0 if associated else share) + ground * (1 - share)
        filled[row, :, :3] = np.rint(mixed.clip(0, top))
    filled[hidden] = (ground, ground, ground, 0)
    return filled


def opaque_part(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return an image's RGB, and the (H, W) bool mask of transparent pixels (None: all opaque)."""
    if pixels.shape[2] == 3:
        return pixels, None
    return np.ascontiguousarray(pixels[:, :, :3]), pixels[:, :, 3] == 0


def continued(pixels: np.ndarray) -> np.ndarray:
    """Fill transparent pixels with the nearest opaque colour, since warps mix adjacent pixels."""
    rgb, hidden = opaque_part(pixels)
    if hidden is None:
        return pixels
    kind = {"distanceType": cv2.DIST_L2, "maskSize": 5, "labelType": cv2.DIST_LABEL_PIXEL}
    _, labels = cv2.distanceTransformWithLabels(hidden.astype(np.uint8), **kind)
    colours = np.zeros((labels.max() + 1, 3), rgb.dtype)
    colours[labels[~hidden]] = rgb[~hidden]
    return np.dstack([colours[labels], pixels[:, :, 3]])
