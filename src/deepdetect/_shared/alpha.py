"""Transparent pixels: they are filled with grey, so that they show nothing, and are told apart.

Inside the package, an image with transparent pixels has a fourth channel, which is 0 there, and the
largest value of its type elsewhere.
"""

from __future__ import annotations

import warnings

import numpy as np

from .opencv import cv2

GREY = 128
"""Transparent pixels get this 8-bit level, because it differs least from most images."""

LITTLE_CONTRAST = 16
"""If no opaque pixel differs by more 8-bit levels from `GREY`, transparent pixels become white,
because a grey drawing would vanish on grey. Chosen by hand."""


def on_grey(
    rgb: np.ndarray, alpha: np.ndarray, opaque: float, name: str, *, associated: bool = False
) -> np.ndarray:
    """Blend a (H, W, 3) uint8 or uint16 image with grey by its alpha, (H, W).

    `opaque` is the value of alpha where the image hides the ground. If `associated`, the colours
    are multiplied by alpha already. Pixels that are more ground than image count as transparent.

    Returns:
        The image itself if it is opaque, or else (H, W, 4), with the fourth channel as above.
    """
    if (alpha >= opaque).all():
        return rgb
    hidden = alpha < opaque / 2
    if hidden.all():
        left_out = f"{name} is transparent everywhere: its alpha channel is left out"
        warnings.warn(left_out, UserWarning, stacklevel=2)
        return rgb
    top = int(np.iinfo(rgb.dtype).max)
    unit = top // 255
    shown = rgb[alpha >= opaque] @ np.array([0.299, 0.587, 0.114]) - GREY * unit
    faint = len(shown) and np.abs(shown).max() <= LITTLE_CONTRAST * unit
    ground = top if faint else GREY * unit
    filled = np.full((*rgb.shape[:2], 4), top, rgb.dtype)
    for row, (colours, part) in enumerate(zip(rgb, alpha, strict=True)):
        share = (part / opaque).clip(0, 1)[:, None]
        mixed = colours * (1.0 if associated else share) + ground * (1 - share)
        filled[row, :, :3] = np.rint(mixed.clip(0, top))
    filled[hidden] = (ground, ground, ground, 0)
    return filled


def hidden_pixels(pixels: np.ndarray) -> np.ndarray | None:
    """Return the (H, W) bool mask of the transparent pixels of an image, or None without any."""
    return pixels[:, :, 3] == 0 if pixels.shape[2] == 4 else None


def joined(*masks: np.ndarray | None) -> np.ndarray | None:
    """Return where any of the masks is true, each (H, W) or None; None if all are None."""
    given = [np.asarray(mask) != 0 for mask in masks if mask is not None]
    return np.logical_or.reduce(given) if given else None


def continued(pixels: np.ndarray) -> np.ndarray:
    """Give transparent pixels the colours of the nearest opaque ones; warped, these leave no rim."""
    hidden = hidden_pixels(pixels)
    if hidden is None:
        return pixels
    _, labels = cv2.distanceTransformWithLabels(
        hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.zeros(labels.max() + 1, np.intp)
    places[labels[~hidden]] = np.flatnonzero(~hidden)
    found = pixels.copy()
    found[hidden, :3] = pixels.reshape(-1, 4)[places[labels[hidden]], :3]
    return found
