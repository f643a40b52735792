"""Dense disparity maps of rectified pairs, and the matches of keypoints that they give."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._shared.errors import ImageError, OptionError
from ..._shared.image_array import Channels
from ..._shared.opencv import cv2
from ..._shared.options import check_ranges, suggest_keywords
from ...features.keypoints import Keypoints
from ...io.image import load_image, luma
from .consistency import fill_occlusions, filter_speckles, near_discontinuity, on_occluding_edge
from .extrapolation import extrapolate_disparity
from .refinement import refine_disparity
from .sgm import DisparityRange, is_textured, semi_global_matching

MAX_SPECKLE_AREA_PX = 100
"""Patches of one surface up to this size are not kept."""

# The search for the range of disparities, on a small copy of the pair: the range holds all of the
# Motorcycle pair and of the Middlebury scenes of the benchmark, without being much wider.
SEARCH_WIDTH_PX = 160
SEARCH_UNIQUENESS_RATIO = 1.3
"""Least ratio of the cost of any other place on the row: what has no match is rarely so clear."""

SEARCH_MAX_SPECKLE_AREA_PX = 50
SEARCH_TAIL_FRACTION = 0.01
"""Of the disparities at each end, which may be wrong."""

SEARCH_MARGIN_PX = 1.5
SEARCH_MARGIN_FRACTION = 0.2
"""Of the small copy, and of the range, added at both ends for what is too small to be seen."""


@suggest_keywords
@dataclass(frozen=True)
class DisparityOptions:
    """How the disparities of a rectified pair are found, and which of them are kept.

    Attributes:
        disparity_range: smallest and largest disparity in whole pixels; None: found on a small
            copy of the pair.
        uniqueness_ratio: the cost of any other place on the row, over that of the match, is at
            least this.
        discontinuity_margin_px: pixels this near to a disparity discontinuity are left out: the
            windows that are compared extend so far, and give what lies beside a near object its
            disparity. Objects up to twice as wide vanish. 0 keeps them.
        fill_occlusions: give what the right image does not show the disparity of the surface
            beside it: between two surfaces that of the farther one; where the counterpart lies
            outside the right image that of the first surface in sight, extrapolated along a line
            as far as this predicts the surface itself, unless the surfaces above and below suggest
            another. Such pixels have no match: `DisparityMap.matched`.
        occluding_edge_px: so many of the outermost pixels of a nearer surface, and of the columns
            at both ends of the right image, have no match, but are filled as what is hidden there,
            or keep their disparity where that is not known: the windows give them the nearer
            disparity too often. 0 takes them as matched.

    Raises:
        OptionError: a value is out of its range.
    """

    disparity_range: tuple[int, int] | None = None
    uniqueness_ratio: float = 1.05
    discontinuity_margin_px: int = 4
    fill_occlusions: bool = False
    occluding_edge_px: int = 0

    def __post_init__(self) -> None:
        if self.disparity_range is not None:
            if len(self.disparity_range) != 2 or any(int(d) != d for d in self.disparity_range):
                raise OptionError("disparity_range takes two whole disparities, as (0, 63)")
            low, high = self.disparity_range
            if low > high:
                raise OptionError(
                    f"the smallest disparity, {low}, is above the largest, {high}: exchange them"
                )
        check_ranges(
            self,
            between={
                "uniqueness_ratio": (1, math.inf),
                "discontinuity_margin_px": (0, 100),
                "occluding_edge_px": (0, 100),
            },
        )


DENSE = DisparityOptions(
    uniqueness_ratio=1.0, discontinuity_margin_px=0, fill_occlusions=True, occluding_edge_px=1
)
"""As many pixels as possible: those near discontinuities too, and what is hidden is filled."""


@dataclass(frozen=True, eq=False)
class RectifiedMatches:
    """Keypoints of the left view of a rectified pair with their disparities.

    Attributes:
        indices: (K,) int64 of the keypoints that have a disparity, rising.
        disparity: (K,) float32 in pixels: the match of the left (x, y) is the right
            (x - disparity, y).
        matched: (K,) bool: seen in both views; False where the disparity is filled in from the
            surface beside: hidden in the right view, outside of it, or on the edge of what hides.
    """

    indices: np.ndarray
    disparity: np.ndarray
    matched: np.ndarray

    def __len__(self) -> int:
        return len(self.indices)


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class DisparityMap:
    """The disparity of each pixel of the left view of a rectified pair.

    Attributes:
        disparity: (H, W) float32 in pixels: the match of the left (x, y) is the right
            (x - disparity, y). NaN where there is none that can be trusted.
        matched: (H, W) bool: seen in both views, so that (x - disparity, y) lies in the right one;
            False where the disparity is NaN or filled in from the surface beside: hidden in the
            right view, outside of it, or on the edge of what hides.
        disparity_range: smallest and largest disparity that were tried; None where the views agree
            on nothing.
    """

    disparity: np.ndarray
    matched: np.ndarray
    disparity_range: DisparityRange | None

    def __repr__(self) -> str:
        height, width = self.disparity.shape
        known, matched = np.isfinite(self.disparity).mean(), self.matched.mean()
        return f"DisparityMap({width}x{height}, {known:.1%} known, {matched:.1%} matched)"

    def at(self, keypoints: Keypoints | np.ndarray) -> RectifiedMatches:
        """Return the disparities of keypoints: the map is only sampled, nothing is matched again.

        Args:
            keypoints: of the left view, on whole pixels; or their (N, 2) positions.

        Raises:
            OptionError: they are not (N, 2), or not on pixels of the left view.
        """
        column, row = _whole_pixels(keypoints, self.disparity.shape)
        disparity = self.disparity[row, column]
        indices = np.flatnonzero(np.isfinite(disparity))
        matched = self.matched[row[indices], column[indices]]
        return RectifiedMatches(indices, disparity[indices], matched)


@suggest_keywords
def disparity_map(
    left: Any,
    right: Any,
    options: DisparityOptions = DisparityOptions(),
    *,
    channels: Channels = "rgb",
) -> DisparityMap:
    """Find the disparity of every pixel of the left view of a rectified pair.

    Census transform and semi-global matching; both views must agree, no other place on the row may
    be as good, small patches apart from all around are left out, and so is what lies near a
    disparity discontinuity. Then the disparities are refined to sub-pixel accuracy. The light may
    differ between the views. No detector takes part: for rectified pairs `reconstruct` takes its
    points from this map, at the keypoints of the left image.

    Args:
        left, right: images of the same size, anything `load_image` takes; only their luma is used.
        options: what is matched and kept; `DENSE` gives as many pixels as possible.
        channels: order of the colours in images that are arrays, as of `load_image`.

    Returns:
        The disparities, the same for any number of threads.

    Raises:
        ImageError: the images cannot be read, or differ in size.
        OptionError: the disparity range is wider than the image.
        MissingExtraError: numba is not installed.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (64, 120), np.uint8)
        >>> scene = cv2.GaussianBlur(scene, (0, 0), 1)
        >>> found = disparity_map(scene[:, :100], scene[:, 12:112])
        >>> float(np.nanmedian(found.disparity).round(1))
        12.0
        >>> found.at(np.array([[40, 20], [60, 30], [2, 30]])).indices.tolist()
        [0, 1]
    """
    grays = [luma(load_image(image, channels=channels)) for image in (left, right)]
    return compute_disparity(grays[0], grays[1], options)


def compute_disparity(
    left: np.ndarray, right: np.ndarray, options: DisparityOptions = DisparityOptions()
) -> DisparityMap:
    """Compute the `disparity_map` of (H, W) uint8 luma."""
    if left.shape != right.shape:
        sizes = " and ".join(f"{view.shape[1]}x{view.shape[0]}" for view in (left, right))
        raise ImageError(f"the views of a rectified pair must have one size, not {sizes}")
    disparities = _disparity_range(left, right, options)
    if disparities is None:
        nowhere = np.zeros(left.shape, bool)
        return DisparityMap(np.full(left.shape, np.nan, np.float32), nowhere, None)
    found = semi_global_matching(left, right, disparities)
    clear = found.uniqueness_ratio >= options.uniqueness_ratio
    trusted = found.consistent & clear & is_textured(left)
    known = filter_speckles(found.disparity, trusted, MAX_SPECKLE_AREA_PX)
    disparity = refine_disparity(left, right, found.disparity, known)
    known &= _leads_inside(disparity)
    sure = known
    if options.occluding_edge_px:
        sure = _leads_inside(disparity, options.occluding_edge_px) & ~on_occluding_edge(
            disparity, known, options.occluding_edge_px
        )
        sure &= known
    kept = known
    if options.discontinuity_margin_px:
        kept = known & ~near_discontinuity(disparity, known, options.discontinuity_margin_px)
    matched = kept & sure
    if options.fill_occlusions:
        behind, occluded = fill_occlusions(disparity, sure)
        beyond = extrapolate_disparity(disparity, sure, found.disparity)
        occluded &= ~sure
        extrapolated = ~known & np.isfinite(beyond)
        disparity = np.where(occluded, behind, np.where(extrapolated, beyond, disparity))
        kept = kept | (occluded & ~known) | extrapolated
    return DisparityMap(np.where(kept, disparity, np.float32(np.nan)), matched, disparities)


def _leads_inside(disparity: np.ndarray, margin_px: int = 0) -> np.ndarray:
    """Return where disparities lead to a column of the right image, less a margin; (H, W) bool."""
    width = disparity.shape[1]
    place = np.arange(width, dtype=np.float32) - disparity
    return (place >= margin_px - 0.5) & (place <= width - 0.5 - margin_px)


def find_disparity_range(left: np.ndarray, right: np.ndarray) -> DisparityRange | None:
    """Find the disparities of a rectified pair, of both signs and up to half its width.

    A small copy of the pair is matched over all of them. What both views agree on, in patches of
    some size, gives the range.

    Returns:
        Smallest and largest, or None where the views agree on nothing.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (30, 80), np.uint8)
        >>> scene = cv2.resize(scene, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
        >>> low, high = find_disparity_range(scene[:, 40:300], scene[:, :260])
        >>> low <= -40 <= high < 0
        True
    """
    height, width = left.shape
    scale = max(width / SEARCH_WIDTH_PX, 1.0)
    if scale > 1:
        size = (round(width / scale), max(round(height / scale), 1))
        left, right = (
            cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in (left, right)
        )
        scale = width / size[0]
    half = left.shape[1] // 2
    found = semi_global_matching(left, right, (-half, half))
    clear = found.consistent & (found.uniqueness_ratio >= SEARCH_UNIQUENESS_RATIO)
    known = filter_speckles(found.disparity, clear, SEARCH_MAX_SPECKLE_AREA_PX)
    if not known.any():
        return None
    low, high = np.quantile(
        found.disparity[known], [SEARCH_TAIL_FRACTION, 1 - SEARCH_TAIL_FRACTION]
    )
    margin = SEARCH_MARGIN_PX + SEARCH_MARGIN_FRACTION * (high - low)
    smallest = int(np.floor((low - margin) * scale))
    largest = int(np.ceil((high + margin) * scale))
    return max(smallest, 1 - width), min(largest, width - 1)


def _disparity_range(
    left: np.ndarray, right: np.ndarray, options: DisparityOptions
) -> DisparityRange | None:
    """Return the range that is given, or the one that is found."""
    if options.disparity_range is None:
        return find_disparity_range(left, right)
    low, high = (int(disparity) for disparity in options.disparity_range)
    width = left.shape[1]
    if max(abs(low), abs(high)) >= width:
        raise OptionError(
            f"disparities from {low} to {high} do not fit images {width} pixels wide: narrow "
            "disparity_range"
        )
    return low, high


def _whole_pixels(
    keypoints: Keypoints | np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows of keypoints that lie on pixels of an image."""
    xy = np.asarray(keypoints.xy if isinstance(keypoints, Keypoints) else keypoints)
    if xy.ndim != 2 or xy.shape[1] != 2 or xy.dtype.kind not in "iuf":
        raise OptionError(f"keypoints must be an array of shape (N, 2), not {xy.shape}")
    pixels = np.rint(np.where(np.isfinite(xy), xy, -1)).astype(np.int64)
    height, width = shape
    inside = (pixels >= 0).all() and (pixels < [width, height]).all()
    if (pixels != xy).any() or not inside:
        raise OptionError(
            "rectified matching takes keypoints on whole pixels of the left view: detect them with "
            "subpixel=False"
        )
    return pixels[:, 0], pixels[:, 1]
