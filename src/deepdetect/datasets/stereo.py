"""A rectified stereo pair with its true disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two rectified views: the match of the left (x, y) is the right (x - disparity, y).

    Attributes:
        name: of the scene.
        left, right: (H, W, 3) uint8 RGB.
        disparity: (H, W) float32 in pixels, of the left view; NaN where it is unknown.
    """

    name: str
    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray
