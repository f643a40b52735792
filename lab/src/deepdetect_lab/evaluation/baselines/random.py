"""Chance baselines: detectors that do not use the content of the image."""

from __future__ import annotations

import hashlib

import numpy as np

from deepdetect.features.keypoints import Keypoints, bayer_order
from deepdetect.features.selection import SelectionOptions, select_keypoints
from deepdetect.io.image import load_image

from .method import PAPER_DESCRIPTOR, LocalFeature


class RandomDetector:
    """A detector that gives each pixel a random probability, newly drawn in each call."""

    def __init__(self, seed: int = 0) -> None:
        self._generator = np.random.default_rng(seed)

    def heatmap(self, image: object) -> np.ndarray:
        """Draw a probability for each pixel."""
        return self._generator.random(load_image(image).shape[:2], dtype=np.float32)


class AllPixels:
    """A detector that marks every pixel as a keypoint."""

    def heatmap(self, image: object) -> np.ndarray:
        """Return 1 for each pixel."""
        return np.ones(load_image(image).shape[:2], np.float32)


def random_feature(like: LocalFeature, name: str = "random") -> LocalFeature:
    """Make a baseline that marks as many random pixels in each image as `like` finds keypoints."""

    def detect(rgb: np.ndarray) -> Keypoints:
        # The seed is computed from the image, so that the images of a pair get different pixels.
        seed = int.from_bytes(hashlib.sha256(rgb.tobytes()).digest()[:4], "little")
        count = len(like.detect(rgb))
        size = (rgb.shape[1], rgb.shape[0])
        if not count:
            return Keypoints.empty(size)
        options = SelectionOptions(threshold=0, max_keypoints=count)
        points = select_keypoints(RandomDetector(seed).heatmap(rgb), options)
        return Keypoints(points.xy, points.scores, size)

    title = f"baseline: as many random points as {like.title}"
    version = f"{like.name} {like.version} 0"
    return LocalFeature(name, title, detect, PAPER_DESCRIPTOR.describe, version=version)


def all_pixels_feature() -> LocalFeature:
    """Make a baseline that marks all pixels, ranked so that the best N form a grid for any N."""

    def detect(rgb: np.ndarray) -> Keypoints:
        height, width = rgb.shape[:2]
        row, column = (part.ravel() for part in np.indices((height, width)))
        xy = np.column_stack([column, row])
        return Keypoints(xy, 1 - bayer_order(xy, (width, height)), (width, height))

    title = "baseline: all pixels (a grid, where there is a budget)"
    return LocalFeature("all-pixels", title, detect, PAPER_DESCRIPTOR.describe)
