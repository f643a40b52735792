"""Which images are of low visibility."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from .._shared.errors import unknown_name
from .._shared.options import suggest_keywords

Visibility = Literal["normal", "low"]
VisibilityChoice = Literal["auto", "normal", "low"]

LOW_VISIBILITY_RANGE = 64
"""An image whose luma spans fewer grey levels than this is of low visibility."""


@suggest_keywords
def luma_range(gray: np.ndarray) -> float:
    """Return the span of luma between the 1st and the 99th percentile, in grey levels.

    Args:
        gray: (H, W) uint8 luma.
    """
    histogram = np.bincount(gray.ravel(), minlength=256)
    cumulative = np.cumsum(histogram) / gray.size
    darkest, brightest = np.searchsorted(cumulative, [0.01, 0.99])
    return float(brightest - darkest)


@suggest_keywords
def visibility_of(gray: np.ndarray, choice: VisibilityChoice = "auto") -> Visibility:
    """Decide which detector settings an image gets.

    An image is of low visibility when its luma spans fewer than 64
    grey levels between the 1st and the 99th percentile. (The paper's darkened
    images span at most 32; its normal ones at least 146.)

    Args:
        gray: (H, W) uint8 luma.
        choice: "auto" applies the rule, "normal" and "low" override it.

    Returns:
        "normal" or "low".

    Raises:
        OptionError: the choice is unknown.

    Example:
        >>> visibility_of(np.full((16, 16), 20, np.uint8))
        'low'
    """
    if choice not in get_args(VisibilityChoice):
        raise unknown_name("visibility", choice, get_args(VisibilityChoice))
    if choice != "auto":
        return choice
    return "low" if luma_range(gray) < LOW_VISIBILITY_RANGE else "normal"
