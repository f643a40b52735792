"""Semi-global matching of a rectified pair: every pixel's disparity to whole pixels.

After Hirschmüller, "Stereo processing by semi-global matching and mutual information" (PAMI 2008):
the cost of a disparity, of the census, plus what its neighbours say along eight straight paths.
Along a path a disparity one apart costs a little and any other more, but less across an edge of
the image, where depth may jump.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.parallel import parallel_for
from .census import UNITS, census, matching_cost

SMALL_STEP = 20
LARGE_STEP = 100
EDGE = 8
"""Steps in bits of the census a pixel; the large one is halved where the grey changes by EDGE.

The best of a few tried on the Motorcycle pair; noisy full-size photographs would take larger ones.
"""

LANES = 16
"""Disparities are made a multiple of so many, for the processor's wide registers."""

VOLUME_BYTES = 400_000_000
"""More than that is done in bands of rows, one after the other."""

OVERLAP = 32
"""Rows around a band from which paths come into it."""


@dataclass(frozen=True)
class SearchRange:
    """The disparities that are tried.

    Attributes:
        smallest, largest: in whole pixels; the match of a left (x, y) is looked for from the
            right x - largest to x - smallest. Below 0 where the right view lies to its right.

    Raises:
        OptionError: the smallest is above the largest.

    Example:
        >>> SearchRange(-4, 11).count
        16
    """

    smallest: int
    largest: int

    def __post_init__(self) -> None:
        if self.smallest > self.largest:
            raise OptionError(
                f"the smallest disparity, {self.smallest}, is above the largest, {self.largest}: "
                "exchange them"
            )

    @property
    def count(self) -> int:
        """Number of disparities."""
        return self.largest - self.smallest + 1


@dataclass(frozen=True, eq=False)
class DisparityMap:
    """Disparities of the left view, before they are judged.

    Attributes:
        disparity: (H, W) float32 in pixels.
        known: (H, W) bool: both views agree on it within a pixel.
        unique: (H, W) float32: the least cost of a place elsewhere on the row over the cost of
            this one, at least 1.
    """

    disparity: np.ndarray
    known: np.ndarray
    unique: np.ndarray


def semi_global(left: np.ndarray, right: np.ndarray, search: SearchRange) -> DisparityMap:
    """Match every pixel of the left view along its row.

    Args:
        left, right: (H, W) uint8 luma of a rectified pair.
        search: the disparities to be tried.

    Returns:
        The disparities, below the pixel by a parabola; these still crowd around whole pixels.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (40, 80), np.uint8)
        >>> found = semi_global(scene[:, :60], scene[:, 5:65], SearchRange(0, 15))
        >>> float(np.median(found.disparity[found.known]).round())
        5.0
    """
    height, width = left.shape
    count = -(-search.count // LANES) * LANES
    censuses = census(left), census(right)
    found = DisparityMap(
        np.zeros((height, width), np.float32),
        np.zeros((height, width), bool),
        np.ones((height, width), np.float32),
    )
    rows = max(VOLUME_BYTES // (3 * width * count) - 2 * OVERLAP, OVERLAP)
    if height <= rows + 2 * OVERLAP:
        rows = height
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(top - OVERLAP, 0), min(bottom + OVERLAP, height)
        parts = (part[first:last] for part in (left, *censuses))
        total = _volume(*parts, search.smallest, count)
        inside = total[top - first : bottom - first]
        _choose(inside, search, slice(top, bottom), found)
    return found


def _volume(
    gray: np.ndarray, left: np.ndarray, right: np.ndarray, smallest: int, count: int
) -> np.ndarray:
    """Return the (H, W, D) uint16 costs of a pair's censuses, summed over the eight paths."""
    from . import semi_global_kernel as kernel

    height, width = gray.shape
    cost = matching_cost(left, right, smallest, count)
    total = np.zeros(cost.shape, np.uint16)
    small = np.uint16(SMALL_STEP * UNITS)
    large = np.maximum(LARGE_STEP / (1 + np.arange(256) / EDGE), 1.25 * SMALL_STEP)
    steps = (small, (large * UNITS).astype(np.uint16))
    for direction in (1, -1):
        parallel_for(
            height,
            lambda first, last, direction=direction: kernel.sum_along_rows(
                first, last, gray, cost, total, direction, *steps
            ),
        )
        for slant in (-1, 0, 1):
            parallel_for(
                width,
                lambda first, last, direction=direction, slant=slant: kernel.sum_along_columns(
                    first, last, gray, cost, total, direction, slant, *steps
                ),
            )
    return total


def _choose(total: np.ndarray, search: SearchRange, rows: slice, found: DisparityMap) -> None:
    """Write the best disparities of a volume into the rows of the map that it is of."""
    from . import semi_global_kernel as kernel

    into = (found.disparity[rows], found.known[rows], found.unique[rows])
    parallel_for(
        len(total),
        lambda first, last: kernel.best_of_rows(
            first, last, total, search.smallest, search.count, *into
        ),
    )
