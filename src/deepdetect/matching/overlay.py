"""Find overlays, which stand still while the scene moves: frames, captions, logos, a car's bonnet.

A region that looks the same at the same pixels of two images is an overlay if all matches around it
move clearly and agree with one geometry, and moving matches fill more of the image than still ones.
A region that shifts as a whole by a fraction of a pixel is a distant part of the scene.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .._shared.opencv import cv2
from ..features.selection import check_ignore, grid_subsample
from ..geometry.frames import FRAME_MARGIN_PX, MIN_COMMON, filled_smoothly, uniform_frame, widened
from ..geometry.images import BLUR_SIGMA_PX, gaussian_blur
from ..geometry.transforms import scaled_points
from ..io.image import at_pixels, luma
from .guided import ImagePair, Pair, Sources
from .guided.proposals import propose

COMPARED_SIDE_PX = 640
"""Images are reduced to this longer side before they are compared: captions stay legible at this
size. All lengths below are in pixels of the reduced images."""

WINDOW_PX, MAX_DIFFERENCE, MIN_LIKENESS, MIN_GRADIENTS = 7, 0.3, 0.95, 32.0
"""A place looks the same in two images if, in a window of side WINDOW_PX, the difference of their
gradients is below MAX_DIFFERENCE times the sum of both, or their correlation is above MIN_LIKENESS
(letters before a brighter ground), and the sum is above MIN_GRADIENTS: 2 grey levels per pixel in
each image, times the gain 8 of Sobel's filter. 313 pairs without an overlay gave no false one."""

MAX_STILL_PX, MIN_MOTION_PX, NEIGHBOURS = 1.5, 3.0, 8
"""A match stands still if it moves by less than MAX_STILL_PX, about the error of a keypoint. The
scene clearly moves at a place if its NEIGHBOURS nearest moving matches move by more than
MIN_MOTION_PX, which few do at the far end of a street along which the camera drives."""

MIN_AREA_PX, MIN_CLEAR_SHARE = 128, 0.67
"""A still region is an overlay if the scene clearly moves at the fraction MIN_CLEAR_SHARE of it,
and if MIN_AREA_PX of its pixels (half a word of a caption) look different where the scene moves to.
WINDOW_PX^2 of these pixels are enough if they shift by less than MAX_SHIFT_PX: in 177 real pairs,
no pixel does so, in a time stamp 62 do, on a car's bonnet 7,000."""

MAX_SHIFT_PX, MIN_UNITY, MIN_ROUNDNESS = 0.15, 0.6, 0.5
"""A region is distant scene, not an overlay, if its median shift vector is longer than MAX_SHIFT_PX
and than MIN_UNITY times the median length of its pixels' shifts: shifts within a text differ. A
pixel's shift is known if its window's structure tensor has a determinant above MIN_ROUNDNESS times
the squared half trace, because an edge that moves along itself looks still."""

CELL_PX = 32
"""The motion of the scene is interpolated between the centres of squares of this side. The areas of
still and of moving matches are compared by the number of squares that contain some."""

SOBEL_GAIN = 8
"""Sobel's 3 x 3 filter returns this multiple of the gradient."""


_Matched = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Positions of matches in two reduced images, (K, 2) each, and which show the scene, (K,) bool."""


def scene_of(
    images: Pair, masks: Sequence[np.ndarray | None], seed: int = 0
) -> tuple[ImagePair, float]:
    """Leave out the uniform borders of two (H, W, 3) images, and overlays that stand still.

    Returns both images as luma, with these areas filled smoothly and added to the ignore `masks`;
    and the share of the image that stands still, which a warning states.
    """
    left = [uniform_frame(image) for image in images]
    first, second = (filled_smoothly(luma(each), m) for each, m in zip(images, left, strict=True))
    pair, share = ImagePair((first, second)), 0.0
    if first.shape == second.shape:
        overlay = _overlay_of([pair], seed)
        if overlay.any():
            left = [mask | overlay for mask in left]
            first, second = (filled_smoothly(gray, overlay) for gray in pair.grays)
            pair = ImagePair((first, second))
        both = left[0] & left[1]
        alike = np.count_nonzero(both) >= MIN_COMMON * np.count_nonzero(left[0] | left[1])
        share = float((both if alike else overlay).mean())
    tell_still(share)
    ignored = [
        mask if not new.any() else new if mask is None else new | check_ignore(mask, new.shape)
        for mask, new in zip(masks, left, strict=True)
    ]
    return pair.masked(ignored), share


def tell_still(share: float) -> None:
    """Warn that a share of the image, if above 0, is left out because it stands still."""
    if share:
        warnings.warn(
            f"{share:.1%} of the image stands still while the scene moves (a frame, a caption, a "
            "logo, a part of the vehicle): it is left out",
            UserWarning,
            stacklevel=2,
        )


def still_matches(
    pair: ImagePair, points0: np.ndarray, points1: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return which matches lie on a still overlay, (K,) bool, and the image share it fills."""
    small, scales = pair.both(COMPARED_SIDE_PX)
    still = _same(*small) if pair.sizes[0] == pair.sizes[1] else np.zeros(1, bool)
    if np.count_nonzero(still) < MIN_AREA_PX:
        return np.zeros(len(points0), bool), 0.0
    places, ends = (scaled_points(*each) for each in zip((points0, points1), scales, strict=True))

    def outside(mask: np.ndarray) -> _Matched:
        some = grid_subsample(places, WINDOW_PX)
        return places[some], ends[some], ~at_pixels(mask, places[some])

    _, found, least = _contradicted(still, small, outside)
    if found.any():  # an overlay attracts the matches around it, so they are no evidence
        around = widened(still, FRAME_MARGIN_PX)
        _, found, least = _contradicted(still, small, lambda _: outside(around))
    overlay = found & (least > MIN_MOTION_PX)
    slow = np.linalg.norm(ends - places, axis=1) < MIN_MOTION_PX
    return slow & at_pixels(overlay, places), float(overlay.mean())


def find_overlay(grays: Sequence[np.ndarray], seed: int = 0, *, moves: bool = False) -> np.ndarray:
    """Return an (H, W) bool mask of the overlay in (H, W) uint8 images; empty if sizes differ.

    An overlay stands still in all images, and contradicts the motion from one image to the next.
    If the camera certainly `moves`, it may fill most of the image.
    """
    if len({gray.shape for gray in grays}) > 1 or len(grays) < 2:
        return np.zeros(grays[0].shape, bool)
    return _overlay_of([ImagePair(pair) for pair in itertools.pairwise(grays)], seed, moves)


def _overlay_of(pairs: Sequence[ImagePair], seed: int, moves: bool = False) -> np.ndarray:
    small = [pair.both(COMPARED_SIDE_PX)[0] for pair in pairs]
    compared = small if len(small) == 1 else [*small, (small[0][0], small[-1][1])]
    still = np.all([_same(*both) for both in compared], axis=0)
    found = np.zeros(still.shape, bool)
    enough = np.count_nonzero(still) >= MIN_AREA_PX
    for pair, both in zip(pairs, small, strict=True) if enough else ():
        matched = partial(_sparse_matches, pair, seed)
        found |= np.any(_contradicted(still, both, matched, moves)[:2], axis=0)
    whole = cv2.resize(np.uint8(found), pairs[0].sizes[0], interpolation=cv2.INTER_NEAREST)
    return widened(whole, FRAME_MARGIN_PX)


def _sparse_matches(pair: ImagePair, seed: int, exactly_still: np.ndarray) -> _Matched:
    """Match learned points of a reduced pair; matches show the scene if they fit one geometry."""
    _, (scale, _) = pair.both(COMPARED_SIDE_PX)
    found = Sources(pair).learned
    places, ends = (scaled_points(p, scale) for p in (found.points0, found.points1))
    scene = np.linalg.norm(ends - places, axis=1) > MAX_STILL_PX
    proposed = (
        propose(pair, found.chosen(scene), model, seed) for model in ("homography", "fundamental")
    )
    best = min(filter(None, proposed), key=lambda each: each.log10_nfa, default=None)
    scene[scene] = best is not None and best.inliers
    return places, ends, scene & ~at_pixels(exactly_still, places)


def _gradients(gray: np.ndarray) -> np.ndarray:
    blurred = gaussian_blur(gray, BLUR_SIGMA_PX)
    return np.dstack([cv2.Sobel(blurred, -1, *order) for order in ((1, 0), (0, 1))])


def _same(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return where two images have the same gradients, (H, W) bool (see `WINDOW_PX`)."""
    one, other = _gradients(first), _gradients(second)
    lengths = [np.linalg.norm(each, axis=2) for each in (one, other)]
    difference, both, common, *squares = (
        cv2.boxFilter(values, -1, (WINDOW_PX, WINDOW_PX))
        for values in (
            *(np.linalg.norm(one - other, axis=2), lengths[0] + lengths[1]),
            *((one * other).sum(axis=2), lengths[0] ** 2, lengths[1] ** 2),
        )
    )
    alike = common > MIN_LIKENESS * np.sqrt(np.maximum(squares[0] * squares[1], 1))
    return np.asarray(((difference < MAX_DIFFERENCE * both) | alike) & (both > MIN_GRADIENTS))


def _contradicted(
    still: np.ndarray,
    pair: Pair,
    matched: Callable[[np.ndarray], _Matched],
    moves: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find regions of still places that the motion of matches in two reduced images contradicts.

    Returns (H, W) masks of regions that are contradicted over most of their area, and of parts that
    stand exactly still; and, for each pixel, the least motion in pixels of scene matches near it.
    """
    nowhere = (*np.zeros((2, *still.shape), bool), np.zeros(still.shape))
    _, labels = cv2.connectedComponents(np.uint8(widened(still, FRAME_MARGIN_PX)))
    shift, known = _shifts(*pair)

    def stands(places: np.ndarray) -> np.ndarray:
        overlay = np.bincount(labels[places], minlength=labels.max() + 1) >= MIN_AREA_PX
        for label in np.flatnonzero(overlay):
            shifts = shift[places & (labels == label)]
            whole = np.linalg.norm(np.median(shifts, axis=0))
            each = np.median(np.linalg.norm(shifts, axis=1))
            overlay[label] = whole < max(MAX_SHIFT_PX, MIN_UNITY * each)
        return overlay

    if not stands(still & known).any():  # checked first, because `matched` takes longest
        return nowhere
    exactly = still & known & (np.linalg.norm(shift, axis=2) < MAX_SHIFT_PX)
    places, ends, scene = matched(exactly)
    stays = np.linalg.norm(ends - places, axis=1) <= MAX_STILL_PX
    scene = scene & ~stays
    cells, moving_cells = (len(np.unique(places[k] // CELL_PX, axis=0)) for k in (stays, scene))
    # If unmoved matches cover more of the image than moved ones, the camera stands still, and an
    # object moves.
    if np.count_nonzero(scene) < NEIGHBOURS or (cells > moving_cells and not moves):
        return nowhere
    size = still.shape[::-1]
    flow, least = _motion_of_scene(places[scene], (ends - places)[scene], size)
    there = np.float32(np.dstack(np.meshgrid(*map(np.arange, size)))) + flow
    moved = cv2.remap(pair[1], there, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    clear = still & (least > MIN_MOTION_PX)
    shown = clear & known & ~_same(pair[0], moved)
    still_px, clear_px = (
        np.bincount(labels[where], minlength=labels.max() + 1) for where in (still, clear)
    )
    most = stands(shown) & (clear_px >= MIN_CLEAR_SHARE * still_px)
    _, parts = cv2.connectedComponents(
        np.uint8(widened(still & (exactly | ~known), FRAME_MARGIN_PX))
    )
    exact_px = np.bincount(parts[shown & exactly], minlength=parts.max() + 1)
    return most[labels], (exact_px >= WINDOW_PX**2)[parts], least


def _shifts(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shift (H, W, 2) of the window around each pixel, and where it is known."""
    x, y = np.moveaxis(_gradients(first) + _gradients(second), 2, 0) / (2 * SOBEL_GAIN)
    step = gaussian_blur(first, BLUR_SIGMA_PX) - gaussian_blur(second, BLUR_SIGMA_PX)
    xx, xy, yy, xt, yt = (
        cv2.boxFilter(product, -1, (WINDOW_PX, WINDOW_PX))
        for product in (x * x, x * y, y * y, x * step, y * step)
    )
    determinant = np.maximum(xx * yy - xy * xy, 1e-9)
    shift = np.dstack([yy * xt - xy * yt, xx * yt - xy * xt]) / determinant[..., None]
    return shift, 4 * determinant > MIN_ROUNDNESS * (xx + yy) ** 2


def _motion_of_scene(
    scene: np.ndarray, motion: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the nearest matches' median motion (H, W, 2) and least motion length (H, W)."""
    columns, rows = (np.arange(CELL_PX // 2, side + CELL_PX, CELL_PX) for side in size)
    gaps = np.linalg.norm(np.dstack(np.meshgrid(columns, rows))[..., None, :] - scene, axis=-1)
    nearest = motion[np.argpartition(gaps, NEIGHBOURS - 1)[..., :NEIGHBOURS]]
    cells = np.median(nearest, axis=2), np.linalg.norm(nearest, axis=-1).min(axis=-1)
    flow, least = (
        cv2.resize(np.float32(each), None, fx=CELL_PX, fy=CELL_PX)[: size[1], : size[0]]
        for each in cells
    )
    return flow, least
