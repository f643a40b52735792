"""Matches of keypoints along the rows of a rectified pair, below the pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._shared.errors import ImageError, OptionError
from ...io.image import load_image, luma
from .census import textured
from .consistency import behind, depth_edges, without_islands
from .row_refinement import refine_along_rows
from .search_range import find_search_range
from .semi_global import SearchRange, semi_global

ISLAND = 100
"""Pixels; patches of one surface that are smaller are left out."""


@dataclass(frozen=True)
class RowMatchingOptions:
    """How keypoints are matched along rows.

    Attributes:
        search_range: smallest and largest disparity in whole pixels; None: found on a small
            copy of the pair.
        uniqueness: the cost of any other place on the row, over that of the match, is at least
            this.
        edge_distance: keypoints so near to a jump of depth are left out, in pixels: the
            windows that are compared reach so far, and give what lies beside a near thing its
            disparity. Things twice as wide or less vanish. 0 leaves them in.
        fill: give what the right image does not show, between two surfaces, the disparity of
            the farther one. Such points are no matches: `RowMatches.matched` tells them.

    Raises:
        OptionError: a value is out of its range.
    """

    search_range: tuple[int, int] | None = None
    uniqueness: float = 1.05
    edge_distance: int = 4
    fill: bool = False

    def __post_init__(self) -> None:
        if self.search_range is not None:
            if len(self.search_range) != 2 or any(int(d) != d for d in self.search_range):
                raise OptionError("search_range takes two whole disparities, as (0, 63)")
            SearchRange(*self.search_range)
        if not self.uniqueness >= 1:
            raise OptionError(f"uniqueness must be at least 1, not {self.uniqueness}")
        if not 0 <= self.edge_distance <= 100:
            raise OptionError(
                f"edge_distance must be between 0 and 100 pixels, not {self.edge_distance}"
            )


COMPLETE = RowMatchingOptions(uniqueness=1.0, edge_distance=0, fill=True)
"""As many points as can be had: those near jumps of depth too, and hidden ones filled in."""


@dataclass(frozen=True, eq=False)
class RowMatches:
    """Keypoints of the left view with their disparities.

    Attributes:
        rows: (K,) int64 rows of the keypoints that were given, growing.
        disparity: (K,) float32 in pixels: the match of the left (x, y) is the right
            (x - disparity, y).
        matched: (K,) bool: seen in both views; False for those that were filled in.
        search_range: the disparities that were tried; None where the views agree on nothing.
    """

    rows: np.ndarray
    disparity: np.ndarray
    matched: np.ndarray
    search_range: SearchRange | None

    def __len__(self) -> int:
        return len(self.rows)


def match_rows(
    left: Any, right: Any, xy: np.ndarray, options: RowMatchingOptions = RowMatchingOptions()
) -> RowMatches:
    """Find the disparities of keypoints of the left view of a rectified pair.

    All pixels are matched, by the census and semi-global matching, so that the keypoints'
    surroundings tell which of them can be trusted: both views must agree, no other place on the
    row may be as good, small patches apart from all around are left out, and so is what lies
    near a jump of depth. Then the disparities are refined below the pixel. Light may differ
    between the views.

    Args:
        left, right: images of the same size, anything `load_image` takes; only their luma is
            used.
        xy: (N, 2) keypoints of the left view, on whole pixels.
        options: how they are matched.

    Returns:
        The keypoints that were matched, the same for any number of threads.

    Raises:
        ImageError: the images cannot be read, or differ in size.
        OptionError: keypoints are not (N, 2), or not on pixels of the left view, or the search
            range is wider than the image.

    Example:
        >>> import cv2
        >>> scene = np.random.default_rng(0).integers(0, 256, (64, 120), np.uint8)
        >>> scene = cv2.GaussianBlur(scene, (0, 0), 1)
        >>> keypoints = np.array([[40, 20], [60, 30], [2, 30]])
        >>> found = match_rows(scene[:, :100], scene[:, 12:112], keypoints)
        >>> found.rows.tolist(), found.disparity.round(1).tolist()
        ([0, 1], [12.0, 12.0])
    """
    views = [luma(load_image(image)) for image in (left, right)]
    if views[0].shape != views[1].shape:
        sizes = " and ".join(f"{view.shape[1]}x{view.shape[0]}" for view in views)
        raise ImageError(f"the views of a rectified pair must have one size, not {sizes}")
    column, row = _pixels(xy, views[0].shape)
    search = _search_range(*views, options)
    if search is None:
        nothing = np.empty(0)
        return RowMatches(
            nothing.astype(np.int64), nothing.astype(np.float32), nothing.astype(bool), None
        )
    found = semi_global(*views, search)
    clear = found.known & (found.unique >= options.uniqueness) & textured(views[0])
    known = without_islands(found.disparity, clear, ISLAND)
    disparity = refine_along_rows(*views, found.disparity, known)
    kept = known
    if options.edge_distance:
        kept = known & ~depth_edges(disparity, known, options.edge_distance)
    given = kept
    if options.fill:
        filled, between = behind(disparity, known)
        disparity = np.where(known, disparity, filled)
        given = kept | (between & ~known)
    rows = np.flatnonzero(given[row, column])
    column, row = column[rows], row[rows]
    return RowMatches(rows, disparity[row, column], known[row, column], search)


def _pixels(xy: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    given = np.asarray(xy)
    if given.ndim != 2 or given.shape[1] != 2 or given.dtype.kind not in "iuf":
        raise OptionError(f"keypoints must be an array of shape (N, 2), not {given.shape}")
    pixels = np.rint(np.where(np.isfinite(given), given, -1)).astype(np.int64)
    height, width = shape
    inside = (pixels >= 0).all() and (pixels < [width, height]).all()
    if (pixels != given).any() or not inside:
        raise OptionError("matching along rows takes keypoints on whole pixels of the left view")
    return pixels[:, 0], pixels[:, 1]


def _search_range(
    left: np.ndarray, right: np.ndarray, options: RowMatchingOptions
) -> SearchRange | None:
    if options.search_range is None:
        return find_search_range(left, right)
    search = SearchRange(*(int(disparity) for disparity in options.search_range))
    width = left.shape[1]
    if max(abs(search.smallest), abs(search.largest)) >= width:
        raise OptionError(
            f"disparities from {search.smallest} to {search.largest} do not fit images {width} "
            "pixels wide: narrow the search range"
        )
    return search
