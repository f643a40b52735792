"""Dense disparity maps of rectified pairs: what can be trusted of them, and how gaps are filled.

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
from ...io.image import load_image, luma
from .sgm import (
    MAX_DIFFERENCE_PX,
    DisparityRange,
    is_textured,
    refine_disparity,
    semi_global_matching,
)

MAX_SPECKLE_AREA_PX = 100
"""Patches of one surface up to this size are not kept."""

SPECKLE_SUBDIVISIONS = 4
"""Parts of a pixel in which OpenCV's speckle filter counts."""

BORDER_PX = 4
"""Matches this near to the border of the right image are not kept: windows there give what it just
does not show the disparity of what it does."""

OCCLUDING_EDGE_PX = 1
"""Outermost pixels of a nearer surface that are left out where occlusions are filled."""

OCCLUSION_SLACK_PX = 8
"""By which a gap may be wider than the step of disparity explains: the windows on both sides."""

MIN_SUPPORT_PX = 5
"""Fewest known pixels that a line is fitted to."""

# The search for the range of disparities, on a small copy of the pair: the range holds all of the
# Motorcycle pair and of the Middlebury scenes of the benchmark, without being much wider.
SEARCH_WIDTH_PX, SEARCH_MAX_SPECKLE_AREA_PX = 160, 50
SEARCH_UNIQUENESS_RATIO = 1.3
"""Least ratio of the cost of any other place on the row: what has no match is rarely so clear."""

TAIL_FRACTION = 0.01
"""Of the disparities at each end, which may be wrong."""

SEARCH_MARGIN_PX = 1.5
SEARCH_MARGIN_FRACTION = 0.2
"""Of the small copy, and of the range, added at both ends for what is too small to be seen."""


@suggest_keywords
@dataclass(frozen=True)
class DisparityOptions:
    """How the disparities of a rectified pair are found, and which of them are kept.

    Attributes:
        disparity_range: smallest and largest disparity in whole pixels; None: found from the pair.
        uniqueness_ratio: least cost of any other place on the row, over that of the match.
        discontinuity_margin_px: pixels this near to a disparity discontinuity are left out: the
            windows that are compared extend so far, and give what lies beside a near object its
            disparity. Objects up to twice as wide vanish. 0 keeps them.
        fill_occlusions: give what the right image does not show the disparity of the surface
            beside it: between two surfaces that of the farther one, if those above and below give
            the same; where the counterpart lies outside the right image that of the first surface
            in sight, extrapolated along a line as far as this predicts the surface itself, unless
            the surfaces above and below suggest another. Such pixels have no match
            (`DisparityMap.matched`), and the outermost of a nearer surface, which windows give its
            disparity too often, are left out.

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
                f"disparity_range must be the smallest and the largest disparity, not {whole}"
            )
        check_ranges(
            self,
            between={"uniqueness_ratio": (1, math.inf), "discontinuity_margin_px": (0, 100)},
        )


DENSE = DisparityOptions(uniqueness_ratio=1.0, discontinuity_margin_px=0, fill_occlusions=True)
"""Many pixels: those near discontinuities too, and what is hidden is filled where that is sure."""


@dataclass(frozen=True, eq=False)
class RectifiedMatches:
    """Keypoints of the left view of a rectified pair with their disparities.

    Attributes:
        indices: (K,) int64 of the keypoints that have a disparity, rising.
        disparity, matched: (K,) as of `DisparityMap`.
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
        disparity: (H, W) float32 in pixels: the match of the left (x, y) is the right
            (x - disparity, y). NaN where there is none that can be trusted.
        matched: (H, W) bool: seen in both views, so that (x - disparity, y) lies in the right one;
            False where the disparity is NaN or filled in from the surface beside: hidden in the
            right view, or outside of it.
        disparity_range: smallest and largest disparity tried; None where the views do not agree.
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

    Census transform and semi-global matching; both views must agree, no other place on the row may
    be as good, small patches apart from all around are left out, and so is what lies near a
    disparity discontinuity. Then the disparities are refined to sub-pixel accuracy. The light may
    differ between the views. No detector takes part: for rectified pairs `reconstruct` takes its
    points from this map, at the keypoints of the left image.

    Args:
        image0, image1: the left and the right image, of the same size, anything `load_image` takes;
            only their luma is used.
        options: what is matched and kept; `DENSE` gives as many pixels as possible.
        channels: order of the colours in images that are arrays, as of `load_image`.

    Returns:
        The disparities, the same for any number of threads.

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
    grays = [luma(load_image(image, channels=channels)) for image in (image0, image1)]
    return compute_disparity(grays[0], grays[1], options)


def compute_disparity(
    left: np.ndarray, right: np.ndarray, options: DisparityOptions
) -> DisparityMap:
    """Compute the `disparity_map` of (H, W) uint8 luma."""
    if left.shape != right.shape:
        sizes = " and ".join(f"{view.shape[1]}x{view.shape[0]}" for view in (left, right))
        raise ImageError(f"the views of a rectified pair must have one size, not {sizes}")
    disparities = options.disparity_range or find_disparity_range(left, right)
    if disparities is None:
        nowhere = np.zeros(left.shape, bool)
        return DisparityMap(np.full(left.shape, np.nan, np.float32), nowhere, None)
    low, high = (int(disparity) for disparity in disparities)
    if max(abs(low), abs(high)) >= left.shape[1]:
        raise OptionError(
            f"disparities {low} to {high} exceed {left.shape[1]} pixels: narrow disparity_range"
        )
    coarse = semi_global_matching(left, right, (low, high))
    clear = coarse.uniqueness_ratio >= options.uniqueness_ratio
    trusted = coarse.consistent & clear & is_textured(left)
    known = filter_speckles(coarse.disparity, trusted, MAX_SPECKLE_AREA_PX)
    disparity = refine_disparity(left, right, coarse.disparity, known)
    known &= _leads_inside(disparity, BORDER_PX)
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


def _leads_inside(disparity: np.ndarray, margin_px: float) -> np.ndarray:
    """Return where disparities lead to a column of the right image, less a margin; (H, W) bool."""
    width = disparity.shape[1]
    place = np.arange(width, dtype=np.float32) - disparity
    return (place >= margin_px - 0.5) & (place <= width - 0.5 - margin_px)


def find_disparity_range(left: np.ndarray, right: np.ndarray) -> DisparityRange | None:
    """Find the disparities of a rectified pair, of both signs and up to half its width.

    A small copy is matched over all of them; what both views agree on, in patches of some size,
    gives the range. None where they agree on nothing.
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
    """Return the range of most disparities, with a margin at both ends."""
    low, high = np.quantile(disparity, [TAIL_FRACTION, 1 - TAIL_FRACTION])
    margin = margin_px + margin_fraction * (high - low)
    return float(low - margin), float(high + margin)


def filter_speckles(disparity: np.ndarray, known: np.ndarray, max_area_px: int) -> np.ndarray:
    """Return the known pixels without patches of at most so many pixels: most of these are wrong.

    A patch is connected by steps of at most twice `MAX_DIFFERENCE_PX`.
    """
    invalid = np.iinfo(np.int16).min
    steps = np.where(known, np.rint(disparity * SPECKLE_SUBDIVISIONS), invalid).astype(np.int16)
    max_step = round(2 * MAX_DIFFERENCE_PX * SPECKLE_SUBDIVISIONS)
    cv2.filterSpeckles(steps, invalid, max_area_px, max_step)
    return known & (steps != invalid)


def near_discontinuity(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Find the pixels this near to a disparity discontinuity, along rows, columns or both.

    The window of a match there sees both surfaces, and gives a pixel beside the nearer one its
    disparity. Where nothing is known, the farther of both sides is assumed to continue.
    """
    filled = fill_occlusions(disparity, known)[0]
    beside = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    steps = np.maximum(cv2.dilate(filled, beside) - filled, filled - cv2.erode(filled, beside))
    near = (steps > MAX_DIFFERENCE_PX).astype(np.uint8)
    return cv2.dilate(near, _square(distance_px)) > 0


def on_occluding_edge(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Find the outermost known pixels of surfaces in front of others, as wide as `distance_px`.

    The windows of the match give the nearer disparity also to what lies just beside it, so these
    are the least sure. Where nothing is known, the farther of both sides is assumed to continue.
    """
    filled = fill_occlusions(disparity, known)[0]
    farthest = cv2.erode(filled, _square(distance_px))
    return known & (filled - farthest > MAX_DIFFERENCE_PX)


def _square(radius_px: int) -> np.ndarray:
    return np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)


def fill_occlusions(disparity: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown pixels with the farther of the nearest known ones on both sides of their row.

    What the right view does not see lies behind what occludes it. The disparity is 0 in rows where
    nothing is known. The second array is true where both sides are known and the gap is no wider
    than what the nearer surface can occlude.
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
    """Extrapolate the first and the last known surface of each row to the border; else NaN.

    Only to pixels whose place would lie outside the right image, as a surface in sight has matches
    of its own; and only where `carried`, what semi-global matching chooses there, suggests it, too.
    It follows a line, as far as that can be trusted: at a distance of n pixels the line through the
    n known pixels from the nth on must predict those before, to `MAX_DIFFERENCE_PX`.
    """
    from .kernels import extrapolate_rows

    limits = MIN_SUPPORT_PX, np.float32(MAX_DIFFERENCE_PX)
    from_left, from_right = np.full((2, *disparity.shape), np.nan, np.float32)
    views = disparity, known, carried
    mirrored = (np.ascontiguousarray(view[:, ::-1]) for view in views)
    parallel_for(len(disparity), extrapolate_rows, *views, 1.0, *limits, from_left)
    parallel_for(len(disparity), extrapolate_rows, *mirrored, -1.0, *limits, from_right)
    return np.where(np.isfinite(from_left), from_left, from_right[:, ::-1])
