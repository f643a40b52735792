"""A pair of images, which caches everything that is computed from each image."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from functools import cached_property
from typing import TypeVar

import numpy as np

from ...geometry.images import downscale

Pair = tuple[np.ndarray, np.ndarray]
"""Two arrays, one per image: images, (H, W) uint8 luma, or positions of matches, (M, 2) each."""

T = TypeVar("T")


class ImagePair:
    """Two (H, W) uint8 luma images.

    Attributes:
        grays: the images.
        masks: for each image, an (H, W) bool mask of what is left out, or None.
    """

    def __init__(self, grays: Pair, masks: Sequence[np.ndarray | None] = (None, None)) -> None:
        self.grays, self.masks = grays, masks
        self._made: list[dict[Hashable, object]] = [{}, {}]

    @cached_property
    def sizes(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of each image."""
        (height0, width0), (height1, width1) = (gray.shape for gray in self.grays)
        return (width0, height0), (width1, height1)

    def swapped(self) -> ImagePair:
        """Return the pair in the opposite order."""
        other = ImagePair(self.grays[::-1], self.masks[::-1])
        other._made = self._made[::-1]
        return other

    def masked(self, masks: Sequence[np.ndarray | None]) -> ImagePair:
        """Return the same images with other masks."""
        other = ImagePair(self.grays, masks)
        other._made = self._made
        return other

    def once(self, side: int, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of `make` for image number `side`, which is cached under `key`."""
        made = self._made[side]
        if key not in made:
            made[key] = make()
        return made[key]  # type: ignore[return-value]

    def reduced(self, side: int, max_side_px: int) -> tuple[np.ndarray, float]:
        """Return image number `side`, its longer side reduced to `max_side_px`, and its scale."""
        key = "reduced", max_side_px
        return self.once(side, key, lambda: downscale(self.grays[side], max_side_px))

    def both(self, max_side_px: int) -> tuple[Pair, tuple[float, float]]:
        """Return both images, reduced like `reduced`, and their scales."""
        (first, scale0), (second, scale1) = (self.reduced(side, max_side_px) for side in (0, 1))
        return (first, second), (scale0, scale1)
