"""The nine label detectors: one line each, with both settings.

To add a detector, write its module beside this one (a frozen dataclass of
settings and a function from a grey image to a boolean mask) and add its line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .agast import AgastSettings, agast_mask
from .brisk import BriskSettings, brisk_mask
from .canny import CannySettings, canny_mask
from .fast import FastSettings, fast_mask
from .harris import HarrisSettings, harris_mask
from .orb import OrbSettings, orb_mask
from .shi_tomasi import ShiTomasiSettings, shi_tomasi_mask
from .sift import SiftSettings, sift_mask
from .sobel import SobelSettings, sobel_mask


@dataclass(frozen=True)
class LabelDetector:
    """A classical detector, and its settings for normal and for low-visibility images.

    Attributes:
        name: the name users choose it by.
        kind: whether it marks keypoints or edges (the two halves of Figure 4).
        mask: function from a (H, W) uint8 grey image and settings to a (H, W) bool mask.
        normal: settings for a normal image.
        low_visibility: settings for an image with few grey levels.
    """

    name: str
    kind: Literal["keypoint", "edge"]
    mask: Callable[[np.ndarray, Any], np.ndarray]
    normal: Any
    low_visibility: Any


DETECTORS: tuple[LabelDetector, ...] = (
    LabelDetector("sift", "keypoint", sift_mask, SiftSettings(), SiftSettings()),
    LabelDetector("orb", "keypoint", orb_mask, OrbSettings(), OrbSettings()),
    LabelDetector("brisk", "keypoint", brisk_mask, BriskSettings(), BriskSettings()),
    LabelDetector("fast", "keypoint", fast_mask, FastSettings(), FastSettings(threshold=1)),
    LabelDetector("agast", "keypoint", agast_mask, AgastSettings(), AgastSettings(threshold=1)),
    LabelDetector("harris", "keypoint", harris_mask, HarrisSettings(), HarrisSettings()),
    LabelDetector(
        "shi-tomasi", "keypoint", shi_tomasi_mask, ShiTomasiSettings(), ShiTomasiSettings()
    ),
    LabelDetector("canny", "edge", canny_mask, CannySettings(), CannySettings()),
    LabelDetector(
        "sobel", "edge", sobel_mask, SobelSettings(), SobelSettings(relative_threshold=0.5)
    ),
)

DETECTOR_NAMES: tuple[str, ...] = tuple(detector.name for detector in DETECTORS)


def select_detectors(names: Iterable[str]) -> tuple[LabelDetector, ...]:
    """Look detectors up by name, in the order of the registry, each once.

    Raises:
        OptionError: a name is unknown (the nearest right one is named), or there is none.

    Example:
        >>> [d.name for d in select_detectors(["sobel", "fast"])]
        ['fast', 'sobel']
    """
    wanted = set()
    for name in names:
        if name not in DETECTOR_NAMES:
            raise unknown_name("label detector", name, DETECTOR_NAMES)
        wanted.add(name)
    if not wanted:
        raise OptionError(
            f"no label detector was chosen: name at least one of {', '.join(DETECTOR_NAMES)}"
        )
    return tuple(detector for detector in DETECTORS if detector.name in wanted)
