"""Dense disparity maps of rectified pairs: which disparities are reliable, and how gaps are filled.

Maps are (H, W): `disparity` float32 in pixels, `known` bool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._shared.errors import ImageError, OptionError
from ..._shared.image_array import Channels
from ..._shared.machine import parallel_for
from ..._shared.opencv import cv2
from ..._shared.options import check_ranges, suggest_keywords
from ...features.keypoints import Keypoints
from ...io.image import load_pair, luma
from .sgm import (
    MAX_DIFFERENCE_PX,
    DisparityRange,
    is_textured,
    refine_disparity,
    semi_global_matching,
)

MAX_SPECKLE_AREA_PX, SPECKLE_SUBDIVISIONS = 100, 4
"""Isolated patches of at most MAX_SPECKLE_AREA_PX pixels are dropped. Disparities are first rounded
to SPECKLE_SUBDIVISIONS steps per pixel: OpenCV's speckle filter needs integers. Chosen by hand."""

BORDER_PX = 4
"""Matches this near to the left or the right border of the right image are dropped, because windows
give content just outside the image the disparity of content just inside. Chosen by hand."""

OCCLUDING_EDGE_PX, OCCLUSION_SLACK_PX = 1, 8
"""OCCLUDING_EDGE_PX is the width of the edge that nearer surfaces lose if occlusions are filled. A
gap between two surfaces may be an occlusion if its width exceeds their disparity difference by at
most OCCLUSION_SLACK_PX, because windows reach over both ends of the gap."""

MIN_SUPPORT_PX = 5
"""Lines that extrapolate a surface are fitted to at least this many pixels. Chosen by hand."""

SEARCH_WIDTH_PX, SEARCH_MAX_SPECKLE_AREA_PX, SEARCH_UNIQUENESS_RATIO = 160, 50, 1.3
"""If no disparity range is given, it is found by matching copies of this width. Isolated patches up
to SEARCH_MAX_SPECKLE_AREA_PX and matches whose runner-up costs under SEARCH_UNIQUENESS_RATIO times
as much are dropped as mostly false. The ranges found just cover those of Middlebury's scenes."""

TAIL_FRACTION = 0.01
"""This fraction of the disparities at each end of a range is ignored as wrong. Chosen by hand."""

SEARCH_MARGIN_PX, SEARCH_MARGIN_FRACTION = 1.5, 0.2
"""A disparity range found on small copies is extended at both ends by SEARCH_MARGIN_PX (pixels of
the copy) and SEARCH_MARGIN_FRACTION of its length: small objects vanish in the copies."""


@suggest_keywords
@dataclass(frozen=True)
class DisparityOptions:
    """How the disparities of a rectified pair are found, and which of them are kept.

    Attributes:
        disparity_range: smallest and largest disparity in integer pixels. None: the range is
            estimated from the pair.
        uniqueness_ratio: a disparity is kept if the lowest cost of any other match on the row,
            divided by the cost of its own match, is at least this.
        discontinuity_margin_px: disparities within this distance of a disparity discontinuity are
            dropped, because windows reach that far and give pixels beside a near object the
            disparity of the object. Objects up to twice as wide as this vanish. 0 drops nothing.
        fill_occlusions: whether pixels that the right image does not show get the disparity of the
            surface next to them. In a gap between two surfaces, this is the farther surface, if
            filling along the row and along the column agree. Outside the right image, the first
            visible surface is extrapolated along a line, as far as the line can be trusted. Filled
            pixels have no match (`DisparityMap.matched`). The outermost pixels of nearer surfaces
            are dropped, because they often belong to the farther surface.

    Raises:
        OptionError: a value is out of its range.
    """

    disparity_range: tuple[int, int] | None = None
    uniqueness_ratio: float = 1.05
    discontinuity_margin_px: int = 4
    fill_occlusions: bool = False

    def __post_init__(self) -> None:
        whole = self.disparity_range
        if whole and (np.shape(whole) != (2,) or any(d % 1 for d in whole) or whole[0] > whole[1]):
            raise OptionError(
                "disparity_range must be the smallest and the largest disparity in whole pixels, "
                f"not {whole}"
            )
        ranges = {"uniqueness_ratio": (1, math.inf), "discontinuity_margin_px": (0, 100)}
        check_ranges(self, between=ranges)


DENSE = DisparityOptions(uniqueness_ratio=1.0, discontinuity_margin_px=0, fill_occlusions=True)
"""Options for dense maps: discontinuities are kept, occlusions are filled where that is safe."""


@dataclass(frozen=True, eq=False)
class RectifiedMatches:
    """Keypoints of the left view of a rectified pair with their disparities.

    Attributes:
        indices: (K,) int64, ascending: indices of the keypoints that have a disparity.
        disparity, matched: (K,) values of the two arrays of the `DisparityMap` at these keypoints.
    """

    indices: np.ndarray
    disparity: np.ndarray
    matched: np.ndarray

    def __len__(self) -> int:
        return len(self.indices)


@dataclass(frozen=True, eq=False, repr=False)
class DisparityMap:
    """The disparity of each pixel of the left view of a rectified pair.

    Attributes:
        disparity: (H, W) float32 in pixels: pixel (x, y) of the left view matches (x - disparity,
            y) in the right view. NaN where no disparity is reliable.
        matched: (H, W) bool, true where both views show the pixel. False where the disparity is
            NaN, or was filled in because the right view does not show the pixel.
        disparity_range: smallest and largest disparity that were tried; None if the range was to be
            estimated and the views agree nowhere.
    """

    disparity: np.ndarray
    matched: np.ndarray
    disparity_range: DisparityRange | None

    def __repr__(self) -> str:
        height, width = self.disparity.shape
        known, matched = np.isfinite(self.disparity).mean(), self.matched.mean()
        return f"DisparityMap({width}x{height}, {known:.1%} known, {matched:.1%} matched)"

    def at(self, keypoints: Keypoints | np.ndarray) -> RectifiedMatches:
        """Return the disparities at keypoints: the map is only sampled, nothing is matched again.

        Args:
            keypoints: keypoints of the left view, on integer pixels, or their (N, 2) positions.

        Raises:
            OptionError: the positions are not (N, 2), or not integer pixels of the left view.
        """
        xy = np.asarray(keypoints.xy if isinstance(keypoints, Keypoints) else keypoints)
        if xy.ndim != 2 or xy.shape[1] != 2:
            raise OptionError(f"keypoints must be an array of shape (N, 2), not {xy.shape}")
        height, width = self.disparity.shape
        if (xy != np.rint(xy)).any() or ((xy < 0) | (xy >= (width, height))).any():
            raise OptionError(
                "keypoints must be whole pixels of the left view: detect them with subpixel=False"
            )
        column, row = xy.astype(np.int64).T
        disparity = self.disparity[row, column]
        indices = np.flatnonzero(np.isfinite(disparity))
        matched = self.matched[row[indices], column[indices]]
        return RectifiedMatches(indices, disparity[indices], matched)


@suggest_keywords
def disparity_map(
    image0: Any,
    image1: Any,
    options: DisparityOptions = DisparityOptions(),
    *,
    channels: Channels = "rgb",
) -> DisparityMap:
    """Find the disparity of every pixel of the left view of a rectified pair.

    The method is semi-global matching of census transforms. A disparity is kept if both views
    agree, no other place on the row is as good, and it is neither in a small isolated patch nor
    near a disparity discontinuity. Kept disparities are refined to sub-pixel accuracy. The light
    may differ between the views. For rectified pairs, `reconstruct` samples this map.

    Args:
        image0, image1: the left and the right image, of the same size, in any form that
            `load_image` accepts; only their luma is used.
        options: how disparities are found, and which are kept; `DENSE` keeps as many as possible.
        channels: order of the colours in arrays: "rgb", or "bgr" as in OpenCV.

    Returns:
        The disparities, which do not depend on the number of threads.

    Raises:
        ImageError: the images cannot be read, or differ in size.
        OptionError: the disparity range is wider than the image.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (64, 120), np.uint8)
        >>> scene = cv2.GaussianBlur(scene, (0, 0), 1)
        >>> disparities = disparity_map(scene[:, :100], scene[:, 12:112])
        >>> float(np.nanmedian(disparities.disparity).round(1))
        12.0
        >>> disparities.at(np.array([[40, 20], [60, 30], [2, 30]])).indices.tolist()
        [0, 1]
    """
    rgb, (hidden, _) = load_pair((image0, image1), channels)
    found = compute_disparity(luma(rgb[0]), luma(rgb[1]), options)
    if hidden is not None:
        found.disparity[hidden], found.matched[hidden] = np.nan, False
    return found


def compute_disparity(
    left: np.ndarray, right: np.ndarray, options: DisparityOptions
) -> DisparityMap:
    """Compute the `disparity_map` of two views, (H, W) uint8 luma."""
    if left.shape != right.shape:
        sizes = " and ".join(f"{view.shape[1]}x{view.shape[0]}" for view in (left, right))
        raise ImageError(f"the images of a rectified pair must have the same size, not {sizes}")
    disparities = options.disparity_range or find_disparity_range(left, right)
    if disparities is None:
        nowhere = np.zeros(left.shape, bool)
        return DisparityMap(np.full(left.shape, np.nan, np.float32), nowhere, None)
    low, high = (int(disparity) for disparity in disparities)
    if max(abs(low), abs(high)) >= left.shape[1]:
        raise OptionError(
            f"disparities {low} to {high} exceed the image width of {left.shape[1]} pixels: "
            "narrow disparity_range"
        )
    coarse = semi_global_matching(left, right, (low, high))
    clear = coarse.uniqueness_ratio >= options.uniqueness_ratio
    trusted = coarse.consistent & clear & is_textured(left)
    known = filter_speckles(coarse.disparity, trusted, MAX_SPECKLE_AREA_PX)
    disparity = refine_disparity(left, right, coarse.disparity, known)
    width = left.shape[1]
    place = np.arange(width, dtype=np.float32) - disparity
    known &= (place >= BORDER_PX - 0.5) & (place <= width - 0.5 - BORDER_PX)
    matched = known
    if options.discontinuity_margin_px:
        matched = known & ~near_discontinuity(disparity, known, options.discontinuity_margin_px)
    kept = matched
    if options.fill_occlusions:
        sure = known & ~on_occluding_edge(disparity, known, OCCLUDING_EDGE_PX)
        matched = matched & sure
        behind, occluded = fill_occlusions(disparity, sure)
        below = fill_occlusions(disparity.T, sure.T)[0].T
        occluded &= ~known & (np.abs(behind - below) <= MAX_DIFFERENCE_PX)
        beyond = extrapolate_disparity(disparity, sure, coarse.disparity)
        extrapolated = ~known & np.isfinite(beyond)
        disparity = np.where(occluded, behind, np.where(extrapolated, beyond, disparity))
        kept = matched | occluded | extrapolated
    return DisparityMap(np.where(kept, disparity, np.float32(np.nan)), matched, (low, high))


def find_disparity_range(left: np.ndarray, right: np.ndarray) -> DisparityRange | None:
    """Find the disparity range of a rectified pair, of both signs and up to half its width.

    A small copy of the pair is matched over all of these disparities. The range spans the patches
    where both views agree; None if the views agree nowhere.
    """
    height, width = left.shape
    scale = max(width / SEARCH_WIDTH_PX, 1.0)
    if scale > 1:
        size = (round(width / scale), max(round(height / scale), 1))
        small = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (left, right))
        (left, right), scale = small, width / size[0]
    half = left.shape[1] // 2
    coarse = semi_global_matching(left, right, (-half, half))
    clear = coarse.consistent & (coarse.uniqueness_ratio >= SEARCH_UNIQUENESS_RATIO)
    known = filter_speckles(coarse.disparity, clear, SEARCH_MAX_SPECKLE_AREA_PX)
    if not known.any():
        return None
    low, high = range_with_margin(coarse.disparity[known], SEARCH_MARGIN_PX, SEARCH_MARGIN_FRACTION)
    return max(math.floor(low * scale), 1 - width), min(math.ceil(high * scale), width - 1)


def range_with_margin(
    disparity: np.ndarray, margin_px: float, margin_fraction: float
) -> tuple[float, float]:
    """Return the range of disparities without its tails (`TAIL_FRACTION`), plus a margin."""
    low, high = np.quantile(disparity, [TAIL_FRACTION, 1 - TAIL_FRACTION])
    margin = margin_px + margin_fraction * (high - low)
    return float(low - margin), float(high + margin)


def filter_speckles(disparity: np.ndarray, known: np.ndarray, max_area_px: int) -> np.ndarray:
    """Return the mask of the known pixels without small patches, which are mostly wrong.

    Patches of at most `max_area_px` pixels are removed. Neighbouring pixels are in one patch if
    their disparities differ by at most twice `MAX_DIFFERENCE_PX`.
    """
    invalid = np.iinfo(np.int16).min
    steps = np.where(known, np.rint(disparity * SPECKLE_SUBDIVISIONS), invalid).astype(np.int16)
    max_step = round(2 * MAX_DIFFERENCE_PX * SPECKLE_SUBDIVISIONS)
    cv2.filterSpeckles(steps, invalid, max_area_px, max_step)
    return known & (steps != invalid)


def near_discontinuity(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Return which pixels are within `distance_px` of a disparity discontinuity, (H, W) bool.

    Unknown pixels count as part of the farther of the known surfaces left and right of them.
    """
    filled = fill_occlusions(disparity, known)[0]
    beside = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    steps = np.maximum(cv2.dilate(filled, beside) - filled, filled - cv2.erode(filled, beside))
    near = (steps > MAX_DIFFERENCE_PX).astype(np.uint8)
    return cv2.dilate(near, _square(distance_px)) > 0


def on_occluding_edge(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Return which known pixels of nearer surfaces are within `distance_px` of a farther one.

    Unknown pixels count as part of the farther of the known surfaces left and right of them.
    """
    filled = fill_occlusions(disparity, known)[0]
    farthest = cv2.erode(filled, _square(distance_px))
    return known & (filled - farthest > MAX_DIFFERENCE_PX)


def _square(radius_px: int) -> np.ndarray:
    return np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)


def fill_occlusions(disparity: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown pixels with the smaller of the nearest known disparities left and right of them.

    The smaller disparity is used because what the right view does not show lies behind the surface
    that occludes it. Rows where nothing is known get 0. The second array, (H, W) bool, is true in
    gaps between two known pixels that are no wider than the nearer surface can occlude.
    """
    width = disparity.shape[1]
    column = np.arange(width)
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    at_left, at_right = (
        np.take_along_axis(disparity, np.clip(at, 0, width - 1), axis=1) for at in (left, right)
    )
    has_left, has_right = left >= 0, right < width
    farther = np.where(has_left, at_left, at_right)
    farther = np.where(has_left & has_right, np.minimum(at_left, at_right), farther)
    occluded = right - left - 1 <= np.abs(at_left - at_right) + OCCLUSION_SLACK_PX
    filled = np.where(has_left | has_right, farther, np.float32(0))
    return filled, has_left & has_right & occluded


def extrapolate_disparity(
    disparity: np.ndarray, known: np.ndarray, carried: np.ndarray
) -> np.ndarray:
    """Extrapolate the first and the last known surface of each row to the border; NaN elsewhere.

    Only pixels whose match would lie outside the right image are extrapolated, along a line fitted
    to the surface. The surface must agree with `carried`, the result of semi-global matching. The
    line is trusted up to n pixels beyond the edge of the surface if, at the edge, lines fitted to
    its first n and to its next n pixels agree to within `MAX_DIFFERENCE_PX`.
    """
    from .kernels import extrapolate_rows

    limits = MIN_SUPPORT_PX, np.float32(MAX_DIFFERENCE_PX)
    from_left, from_right = np.full((2, *disparity.shape), np.nan, np.float32)
    views = disparity, known, carried
    mirrored = (np.ascontiguousarray(view[:, ::-1]) for view in views)
    parallel_for(len(disparity), extrapolate_rows, *views, 1.0, *limits, from_left)
    parallel_for(len(disparity), extrapolate_rows, *mirrored, -1.0, *limits, from_right)
    return np.where(np.isfinite(from_left), from_left, from_right[:, ::-1])
