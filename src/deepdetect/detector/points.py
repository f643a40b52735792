"""Keypoints of all scales from logits on a pyramid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from .._shared.errors import OptionError
from ..features.keypoints import Keypoints
from ..features.selection import SelectionOptions, select_keypoints
from ..features.suppression import suppress_neighbors

LogitsOf = Callable[[np.ndarray], np.ndarray]
"""From (H, W) float32 grey in [0, 1] to (H, W) float32 logits."""

SIDE_PX = 16
"""Levels of the pyramid have sides of at least this."""


@dataclass(frozen=True)
class PyramidOptions:
    """How keypoints are found on a pyramid.

    Attributes:
        levels: number of levels, the first is the image itself.
        factor: between the sides of neighbouring levels.
        nms_radius: a keypoint ranks highest within this distance in x and y, in pixels of its
            level.
        distance_px: least distance of two keypoints, of whatever levels.
        size_px: diameter of a keypoint in pixels of its level.
    """

    levels: int = 5
    factor: float = 2**0.5
    nms_radius: int = 2
    distance_px: float = 2.0
    size_px: float = 14.0

    def __post_init__(self) -> None:
        if self.levels < 1 or self.factor <= 1 or self.nms_radius < 1 or self.distance_px < 0:
            raise OptionError("a pyramid needs a level or more, a factor over 1 and a radius")


def pyramid(gray: np.ndarray, options: PyramidOptions = PyramidOptions()) -> list[np.ndarray]:
    """Return an image and its smaller copies; those under `SIDE_PX` are left out.

    Example:
        >>> [level.shape for level in pyramid(np.zeros((64, 100), np.float32))]
        [(64, 100), (45, 71), (32, 50), (23, 35), (16, 25)]
    """
    height, width = gray.shape
    found = [gray]
    for k in range(1, options.levels):
        size = tuple(round(side / options.factor**k) for side in (width, height))
        if min(size) < SIDE_PX:
            break
        found.append(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
    return found


def to_full(xy: np.ndarray, size: tuple[int, int], full: tuple[int, int]) -> np.ndarray:
    """Map positions from a level to the image; sizes are (width, height)."""
    scale = np.divide(full, size)
    return (xy + 0.5) * scale - 0.5


def detect_points(
    gray: np.ndarray, logits_of: LogitsOf, options: PyramidOptions = PyramidOptions()
) -> Keypoints:
    """Detect keypoints at all levels; of neighbours the one with the highest logit stays.

    Args:
        gray: (H, W) uint8.
        logits_of: the ranking at one scale.
        options: of the pyramid.

    Returns:
        Keypoints, best first; their logits rank them, and their scores are the logits' sigmoid.
    """
    height, width = gray.shape
    selection = SelectionOptions(threshold=0, nms_radius=options.nms_radius, subpixel=True)
    places, logits, sizes = [], [], []
    for level in pyramid(gray.astype(np.float32) / 255, options):
        map_ = logits_of(level)
        # Every maximum, whatever its sign.
        found = select_keypoints(np.ones_like(map_), selection, map_)
        size = (level.shape[1], level.shape[0])
        places.append(to_full(found.xy, size, (width, height)))
        logits.append(found.logits if found.logits is not None else found.scores)
        sizes.append(np.full(len(found), options.size_px * width / size[0], np.float32))
    xy, ranks, diameters = (np.concatenate(parts) for parts in (places, logits, sizes))
    kept = suppress_neighbors(xy, ranks, options.distance_px)
    scores = 1 / (1 + np.exp(-np.clip(ranks[kept], -80, 80)))
    return Keypoints(xy[kept], scores, (width, height), ranks[kept], diameters[kept])
