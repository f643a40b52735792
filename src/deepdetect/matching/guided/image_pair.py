"""A pair of images, of which each reduced copy is made only once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from ...geometry.images import downscale

Pair = tuple[np.ndarray, np.ndarray]
"""Two arrays, one per image: images, (H, W) uint8 luma, or positions of matches, (M, 2) each."""


class ImagePair:
    """Two (H, W) uint8 luma images.

    Attributes:
        grays: the images.
        masks: for each image, an (H, W) bool mask of what is left out, or None.
    """

    def __init__(self, grays: Pair, masks: Sequence[np.ndarray | None] = (None, None)) -> None:
        self.grays, self.masks = grays, masks
        self._reduced: dict[tuple[int, int], tuple[np.ndarray, float]] = {}

    @cached_property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of each image."""
        (height0, width0), (height1, width1) = (gray.shape for gray in self.grays)
        return (width0, height0), (width1, height1)

    def swapped(self) -> ImagePair:
        """Return the pair in the opposite order."""
        other = ImagePair(self.grays[::-1], self.masks[::-1])
        other._reduced = {(1 - side, most): each for (side, most), each in self._reduced.items()}
        return other

    def reduced(self, side: int, max_side_px: int) -> tuple[np.ndarray, float]:
        """Return image number `side`, its longer side reduced to `max_side_px`, and its scale."""
        key = side, max_side_px
        if key not in self._reduced:
            self._reduced[key] = downscale(self.grays[side], max_side_px)
        return self._reduced[key]

    def both(self, max_side_px: int) -> tuple[Pair, tuple[float, float]]:
        """Return both images, reduced like `reduced`, and their scales."""
        (first, scale0), (second, scale1) = (self.reduced(side, max_side_px) for side in (0, 1))
        return (first, second), (scale0, scale1)
