"""Detectors that know nothing: what a figure at such a density is worth by chance."""

from __future__ import annotations

import numpy as np

from ..io.image import load_image


class RandomPoints:
    """Any pixel is as good as another.

    Args:
        seed: decides which pixels come first.

    Example:
        >>> RandomPoints().heatmap(np.zeros((16, 32), np.uint8)).shape
        (16, 32)
    """

    def __init__(self, seed: int = 0) -> None:
        self._generator = np.random.default_rng(seed)

    def heatmap(self, image: object) -> np.ndarray:
        """Draw a probability for each pixel, others on every call."""
        return self._generator.random(load_image(image).shape[:2], dtype=np.float32)


class EveryPixel:
    """Every pixel is a keypoint."""

    def heatmap(self, image: object) -> np.ndarray:
        """Return ones."""
        return np.ones(load_image(image).shape[:2], np.float32)
