"""Which disparities a rectified pair has: found on a small copy of it.

The constants were chosen so that the range holds all of the Motorcycle pair and of the Middlebury
scenes of the benchmark, without being much wider.
"""

from __future__ import annotations

import cv2
import numpy as np

from .consistency import without_islands
from .semi_global import SearchRange, semi_global

WIDTH = 160
"""Width of the small copy in pixels."""

UNIQUENESS = 1.3
"""Least ratio of the cost of any other place on the row: what has no match is rarely so clear."""

ISLAND = 50
"""Pixels of the small copy; patches that are smaller do not count."""

TAIL = 0.01
"""Share of the disparities at each end that may be wrong."""

MARGIN = 1.5
"""Pixels of the small copy that are added at both ends of what is found there ..."""

MORE = 0.2
"""... and so much of what lies between them, for what is too small to be seen there."""


def find_search_range(left: np.ndarray, right: np.ndarray) -> SearchRange | None:
    """Find the disparities of a rectified pair, of both signs and up to half its width.

    A small copy of the pair is matched over all of them. What both views agree on, patches of
    some size only, gives the range.

    Args:
        left, right: (H, W) uint8 luma.

    Returns:
        The range, or None where the views agree on nothing.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (30, 80), np.uint8)
        >>> scene = cv2.resize(scene, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        >>> found = find_search_range(scene[:, 40:300], scene[:, :260])
        >>> found.smallest <= -40 <= found.largest < 0
        True
    """
    height, width = left.shape
    scale = max(width / WIDTH, 1.0)
    if scale > 1:
        size = (round(width / scale), max(round(height / scale), 1))
        left, right = (
            cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in (left, right)
        )
        scale = width / size[0]
    half = left.shape[1] // 2
    found = semi_global(left, right, SearchRange(-half, half))
    clear = found.known & (found.unique >= UNIQUENESS)
    known = without_islands(found.disparity, clear, ISLAND)
    if not known.any():
        return None
    ends = np.quantile(found.disparity[known], [TAIL, 1 - TAIL])
    margin = MARGIN + MORE * (ends[1] - ends[0])
    smallest = int(np.floor((ends[0] - margin) * scale))
    largest = int(np.ceil((ends[1] + margin) * scale))
    return SearchRange(max(smallest, 1 - width), min(largest, width - 1))
