"""Views of a photograph for training: a size, and normal or darkened light."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np

from ..io.image import load_image, scale_short_side
from .darkening import Darkening, DarkeningRange, darken
from .variation import VERSION as VARIATION_VERSION
from .variation import vary


@dataclass(frozen=True)
class View:
    """How a photograph is shown to the network.

    Attributes:
        short_side: length in pixels that the shorter side is scaled to.
        darkening: the darkening, or None for the photograph as it is.
        square: squashed to a square instead of scaled evenly.
        variation: seed of a varied square (`vary`), or None for the whole photograph.
    """

    short_side: int
    darkening: Darkening | None = None
    square: bool = False
    variation: int | None = None

    @property
    def name(self) -> str:
        """A short text that tells views of one photograph apart, fit for a file name."""
        light = "normal"
        if self.darkening is not None:
            light = f"b{self.darkening.brightness:.3f}c{self.darkening.contrast:.3f}"
        shape = "x" * self.square
        if self.variation is not None:
            shape = f"v{VARIATION_VERSION}-{self.variation:08x}"
        return f"{self.short_side}{shape}_{light}"


def views_of(
    name: str,
    short_sides: tuple[int, ...],
    darkening: DarkeningRange,
    variants: int,
    square: bool = False,
    augmentations: int = 0,
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """List the normal and the dark views of a photograph, the same on every call.

    Args:
        name: the photograph's relative path; its dark views are drawn from it.
        short_sides: sizes of the views, in pixels.
        darkening: ranges of the factors.
        variants: dark views of each size.
        square: squash the photograph to squares.
        augmentations: varied views of the first size, each in normal and in dark light.

    Returns:
        The normal views and the dark ones, of each size in turn, the varied ones last.
    """
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    normal = tuple(View(side, None, square) for side in short_sides)
    dark = tuple(
        View(side, darkening.draw(generator), square)
        for side in short_sides
        for _ in range(variants)
    )
    drawn = np.random.default_rng([zlib.crc32(name.encode()), 1])
    for _ in range(augmentations):
        seed = int(drawn.integers(2**32))
        normal += (View(short_sides[0], None, False, seed),)
        dark += (View(short_sides[0], darkening.draw(drawn), False, seed),)
    return normal, dark


def squash(rgb: np.ndarray, side: int) -> np.ndarray:
    """Scale an image to a square, as the paper's training images are (cubic)."""
    if rgb.shape[:2] == (side, side):
        return rgb
    return cv2.resize(rgb, (side, side), interpolation=cv2.INTER_CUBIC)


def render(photo: object, view: View) -> np.ndarray:
    """Make a view of a photograph.

    Args:
        photo: anything `load_image` takes.
        view: the view.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    if view.variation is not None:
        rgb = vary(load_image(photo), view.short_side, view.variation)
    else:
        scale = squash if view.square else scale_short_side
        rgb = scale(load_image(photo), view.short_side)
    return rgb if view.darkening is None else darken(rgb, view.darkening)
