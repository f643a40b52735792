"""Find what stands still over images whose scene moves: time stamps, logos, the own bonnet.

Places that look the same at the same pixels of both images, and have still sparse matches, would
fit a scene without motion. They are an overlay only if the other sparse matches agree on one
geometry, fill more of the image, and move clearly all around these places.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

import numpy as np

from .._shared.opencv import cv2
from ..features.selection import check_ignore
from ..geometry.frames import FRAME_MARGIN_PX, filled_smoothly, uniform_frame, widened
from ..geometry.images import BLUR_SIGMA_PX, WINDOW_PX, downscale, gaussian_blur, local_zncc
from ..geometry.two_view import choose_model
from ..io.image import luma
from .guided.tentative_matches import Pair, find_tentative_matches

COMPARED_SIDE_PX = 640
"""Images are reduced to this longer side before they are compared: text stays legible in it. All
lengths below are in pixels of the reduced images."""

MIN_STILL_ZNCC = 0.9
"""Windows of two images show the same if their correlation is above this."""

CELL_PX = 16
"""Side of the square cells in which still and moving places are counted. It is about the side of
the windows that are compared."""

MIN_STILL_CELLS, MIN_STILL_MATCHES = 3, 4
"""Fewer still cells or still matches than these may be chance."""

MAX_STILL_PX, MIN_MOTION_PX = 0.75, 3.0
"""A sparse match stands still if it moves by less than the first value, about the error of a
keypoint. The scene moves at a place if most matches around it move by more than the second."""

MIN_CELL_SHARE, MIN_CLEAR_SHARE = 0.25, 0.67
"""A cell is still if this share of its pixels is. A connected still region is an overlay if the
motion of the scene contradicts the second share of its cells; the far end of a street, which hardly
moves for a camera that drives along it, is contradicted at its edges only."""

NEIGHBOURS = 8
"""A place is compared with this many of the nearest matches that move with the scene."""


MIN_SHARED_FRAME = 0.95
"""Frames of two images stand still if their intersection is at least this share of their union."""


def scene_of(
    images: Pair, masks: Sequence[np.ndarray | None], seed: int = 0
) -> tuple[Pair, list[np.ndarray | None], float]:
    """Leave out the frames of two (H, W, 3) images, and what stands still while the scene moves.

    Returns both images as luma, where what is left out is filled smoothly; the `masks` of where no
    keypoint is wanted, widened by it; and which share of the images stands still. If it is above 0,
    a warning says so.
    """
    grays, frames = (luma(images[0]), luma(images[1])), [uniform_frame(each) for each in images]
    first, second = (
        gray if frame is None else filled_smoothly(gray, frame)
        for gray, frame in zip(grays, frames, strict=True)
    )
    overlay = find_overlay((first, second), seed)
    if overlay is not None:
        first, second = filled_smoothly(first, overlay), filled_smoothly(second, overlay)
    left = [
        None if not (each := [m for m in (frame, overlay) if m is not None]) else np.any(each, 0)
        for frame in frames
    ]
    still = 0.0 if overlay is None else float(overlay.mean())
    if left[0] is not None and left[1] is not None and left[0].shape == left[1].shape:
        shared = left[0] & left[1]
        if np.count_nonzero(shared) >= MIN_SHARED_FRAME * np.count_nonzero(left[0] | left[1]):
            still = float(shared.mean())
    if still:
        tell_still(still)
    wanted = [
        mask if new is None else new if mask is None else new | check_ignore(mask, new.shape)
        for mask, new in zip(masks, left, strict=True)
    ]
    return (first, second), wanted, still


def tell_still(share: float) -> None:
    """Warn that a share of the images is left out, because it stands still."""
    warnings.warn(
        f"{share:.1%} of the image stands still while the scene moves (a frame, a caption, a logo, "
        "a part of the vehicle): it is left out",
        UserWarning,
        stacklevel=3,
    )


def find_overlay(grays: Sequence[np.ndarray], seed: int = 0) -> np.ndarray | None:
    """Return where two or more (H, W) uint8 images show one overlay, (H, W) bool, or None.

    It stands still in all images; the scene moves from one to the next, at least once.
    """
    if len({gray.shape for gray in grays}) > 1 or len(grays) < 2:
        return None
    small = [downscale(gray, COMPARED_SIDE_PX)[0] for gray in grays]
    pairs = [*itertools.pairwise(small)]
    still = np.all([still_places(*pair) for pair in (*pairs, (small[0], small[-1]))], axis=0)
    if np.count_nonzero(still) < MIN_STILL_CELLS * CELL_PX**2 * MIN_CELL_SHARE:
        return None
    found = np.zeros(still.shape, bool)
    for pair in pairs:
        tentative = find_tentative_matches(*pair)
        found |= contradicted(still, tentative.points0, tentative.points1, seed)
    if not found.any():
        return None
    size = grays[0].shape[::-1]
    whole = cv2.resize(found.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    return widened(whole, FRAME_MARGIN_PX)


def still_places(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return where two reduced images show the same texture at the same pixels, (H, W) bool."""
    blurred = gaussian_blur(first, BLUR_SIGMA_PX), gaussian_blur(second, BLUR_SIGMA_PX)
    return np.asarray(local_zncc(*blurred, np.ones(first.shape, bool)) > MIN_STILL_ZNCC)


def contradicted(
    still: np.ndarray, points0: np.ndarray, points1: np.ndarray, seed: int = 0
) -> np.ndarray:
    """Return the `still` places, (H, W) bool, that the motion of the scene contradicts, widened.

    `points0` and `points1` are the (M, 2) positions of sparse matches, some of which are wrong.
    """
    nowhere = np.zeros(still.shape, bool)
    motion = np.linalg.norm(points1 - points0, axis=1)
    standing, size = motion < MAX_STILL_PX, still.shape[::-1]
    if np.count_nonzero(standing) < MIN_STILL_MATCHES:
        return nowhere
    others = points0[~standing], points1[~standing]
    model = choose_model(*others, (size, size), "auto", seed, semi_calibrated=False)
    if not model.trusted or np.count_nonzero(model.inliers) < NEIGHBOURS:
        return nowhere
    scene, moved = others[0][model.inliers], motion[~standing][model.inliers]
    regions = widened(still, WINDOW_PX // 2).astype(np.uint8)
    _, labels = cv2.connectedComponents(regions)
    shares = cv2.resize(np.float32(regions), (size[0] // CELL_PX, size[1] // CELL_PX), interpolation=cv2.INTER_AREA)
    rows, columns = np.nonzero(shares > MIN_CELL_SHARE)
    centres = (np.column_stack([columns, rows]) + 0.5) * CELL_PX
    apart, gaps = (_distances(centres, xy) for xy in (points0[standing], scene))
    own = np.sort(apart, axis=1)[:, 1] < np.sort(gaps, axis=1)[:, 1]
    nearest = np.argsort(gaps, axis=1)[:, :NEIGHBOURS]
    clear = own & (moved[nearest].min(axis=1) > MIN_MOTION_PX)
    region = labels[tuple(centres.T[::-1].astype(np.int64))]
    counts, agreed = (np.bincount(region[each], minlength=labels.max() + 1) for each in (own, clear))
    clear &= (agreed >= MIN_CLEAR_SHARE * counts)[region] 
    filled = len(np.unique(scene // CELL_PX, axis=0))
    if not MIN_STILL_CELLS <= np.count_nonzero(clear) <= filled:
        return nowhere
    cells = np.zeros(shares.shape, bool)
    cells[rows[clear], columns[clear]] = True
    near = cv2.resize(np.uint8(widened(cells, 1)), size, interpolation=cv2.INTER_NEAREST) > 0
    return (regions > 0) & near


def _distances(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(one[:, None] - other[None], axis=2))
