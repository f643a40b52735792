"""Find what stands still over images whose scene moves: frames, captions, logos, the own bonnet.

Places that look the same at the same pixels would fit a scene without motion. They are an overlay
only if the sparse matches that move agree on one geometry, fill more of the image than the still
ones, and move clearly all around the still places.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

import numpy as np

from .._shared.opencv import cv2
from ..features.selection import check_ignore
from ..geometry.frames import FRAME_MARGIN_PX, filled_smoothly, uniform_frame, widened
from ..geometry.images import BLUR_SIGMA_PX, downscale, gaussian_blur
from ..geometry.two_view import choose_model
from ..io.image import luma
from .guided.tentative_matches import Pair, find_tentative_matches

COMPARED_SIDE_PX = 640
"""Images are reduced to this longer side before they are compared: captions stay legible in it. All
lengths below are in pixels of the reduced images."""

STILL_WINDOW_PX, MAX_DIFFERENCE, MIN_GRADIENTS = 7, 0.3, 32.0
"""A place may stand still if, in a window of this side, the difference of the gradients of two
images is below the second value times the sum of both, and this sum is above the third: 2 grey
levels per pixel in each image, as Sobel's filter scales them."""

MAX_CORNERS, MIN_QUALITY, MIN_ROUNDNESS, MIN_STILL_CORNERS = 1000, 0.02, 0.2, 4
"""A still place counts at up to this number of corners with this quality, as OpenCV defines it, and
this ratio of the eigenvalues, because an edge that moves along itself looks still. Fewer corners of
a region than the last value may be chance."""

MAX_STILL_PX, MIN_MOTION_PX = 0.75, 3.0
"""A sparse match stands still if it moves by less than the first value, about the error of a
keypoint. The scene clearly moves where matches move by more than the second."""

CELL_PX = 16
"""Still corners and moving matches are counted by the square cells of this side that hold some."""

NEIGHBOURS, MIN_CLEAR_SHARE = 8, 0.67
"""A still corner contradicts the scene if this number of its nearest moving matches all move
clearly. A still region is an overlay if this share of its corners contradicts the scene. At
the end of a street, which hardly moves for a camera that drives along it, few do."""

MIN_COMMON = 0.95
"""The frames of two images stand still if they have this share of their union in common."""


def scene_of(
    images: Pair, masks: Sequence[np.ndarray | None], seed: int = 0
) -> tuple[Pair, list[np.ndarray | None], float]:
    """Leave out the frames of two (H, W, 3) images, and what stands still while the scene moves.

    Returns both images as luma, in which these places are filled smoothly; the ignore `masks`,
    enlarged by them; and the share of the image that stands still, of which a warning tells.
    """
    left = [uniform_frame(image) for image in images]
    grays = [filled_smoothly(luma(each), mask) for each, mask in zip(images, left, strict=True)]
    share = 0.0
    if grays[0].shape == grays[1].shape:
        overlay = find_overlay(grays, seed)
        grays, left = (
            [filled_smoothly(gray, overlay) for gray in grays],
            [m | overlay for m in left],
        )
        both = left[0] & left[1]
        alike = np.count_nonzero(both) >= MIN_COMMON * np.count_nonzero(left[0] | left[1])
        share = float((both if alike else overlay).mean())
    tell_still(share)
    ignored = [
        mask if not new.any() else new if mask is None else new | check_ignore(mask, new.shape)
        for mask, new in zip(masks, left, strict=True)
    ]
    return (grays[0], grays[1]), ignored, share


def tell_still(share: float) -> None:
    """Warn that a share of the image, if above 0, is left out because it stands still."""
    if share:
        warnings.warn(
            f"{share:.1%} of the image stands still while the scene moves (a frame, a caption, a "
            "logo, a part of the vehicle): it is left out",
            UserWarning,
            stacklevel=2,
        )


def find_overlay(grays: Sequence[np.ndarray], seed: int = 0) -> np.ndarray:
    """Return where (H, W) uint8 images show one overlay, (H, W) bool; none if their sizes differ.

    It stands still in all images, and contradicts the motion from one image to the next.
    """
    if len({gray.shape for gray in grays}) > 1 or len(grays) < 2:
        return np.zeros(grays[0].shape, bool)
    small = [downscale(gray, COMPARED_SIDE_PX)[0] for gray in grays]
    pairs = [*itertools.pairwise(small)]
    still = np.all([_still(*pair) for pair in (*pairs, (small[0], small[-1]))], axis=0)
    found = np.zeros(still.shape, bool)
    for pair in pairs if np.count_nonzero(still) >= CELL_PX**2 else ():
        found |= _contradicted(still, pair, seed)
    size = grays[0].shape[::-1]
    whole = cv2.resize(np.uint8(found), size, interpolation=cv2.INTER_NEAREST)
    return widened(whole, FRAME_MARGIN_PX)


def _still(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return where two images have the same gradients, (H, W) bool."""
    (x0, y0), (x1, y1) = (
        [cv2.Sobel(gaussian_blur(gray, BLUR_SIGMA_PX), -1, *order) for order in ((1, 0), (0, 1))]
        for gray in (first, second)
    )
    difference, both = (
        cv2.boxFilter(lengths, -1, (STILL_WINDOW_PX, STILL_WINDOW_PX))
        for lengths in (np.hypot(x1 - x0, y1 - y0), np.hypot(x0, y0) + np.hypot(x1, y1))
    )
    return np.asarray((difference < MAX_DIFFERENCE * both) & (both > MIN_GRADIENTS))


def _contradicted(still: np.ndarray, pair: Pair, seed: int) -> np.ndarray:
    """Return the regions of still places that the motion between two reduced images contradicts."""
    _, labels = cv2.connectedComponents(np.uint8(widened(still, CELL_PX // 2)))
    eigen = cv2.cornerEigenValsAndVecs(gaussian_blur(pair[0], BLUR_SIGMA_PX), STILL_WINDOW_PX, 3)
    round_ = still & (eigen[..., :2].min(axis=2) > MIN_ROUNDNESS * eigen[..., :2].max(axis=2))
    corners = cv2.goodFeaturesToTrack(
        pair[0], MAX_CORNERS, MIN_QUALITY, STILL_WINDOW_PX, mask=np.uint8(round_)
    )
    standing = np.empty((0, 2)) if corners is None else corners[:, 0].astype(np.float64)
    regions = np.bincount(
        labels[tuple(np.rint(standing.T[::-1]).astype(int))], minlength=labels.max() + 1
    )
    if regions[1:].max(initial=0) < MIN_STILL_CORNERS:  # before the matching, which takes longest
        return np.zeros(still.shape, bool)
    tentative, size = find_tentative_matches(*pair), still.shape[::-1]
    motion = np.linalg.norm(tentative.points1 - tentative.points0, axis=1)
    moves = motion > MAX_STILL_PX
    scene, ends = tentative.points0[moves], tentative.points1[moves]
    model = choose_model(scene, ends, (size, size), "auto", seed, semi_calibrated=False)
    scene, motion = scene[model.inliers], motion[moves][model.inliers]
    if not model.trusted or min(len(standing) - MIN_STILL_CORNERS, len(scene) - NEIGHBOURS) < 0:
        return np.zeros(still.shape, bool)
    gaps = np.linalg.norm(standing[:, None] - scene[None], axis=2)
    nearest = np.argpartition(gaps, NEIGHBOURS - 1, axis=1)[:, :NEIGHBOURS]
    clear = standing[motion[nearest].min(axis=1) > MIN_MOTION_PX]
    stands, contradicts, moving = (
        np.bincount(labels[tuple(np.rint(xy.T[::-1]).astype(int))], minlength=labels.max() + 1)
        for xy in (standing, clear, scene[still[tuple(np.rint(scene.T[::-1]).astype(int))]])
    )
    # A region of mostly moving matches is an edge along the motion, which only looks still.
    overlay = contradicts >= np.maximum(
        np.maximum(MIN_CLEAR_SHARE * stands, moving), MIN_STILL_CORNERS
    )
    overlay[0] = False
    # If more of the image stands still than moves, something moves before a still camera.
    cells, moving_cells = (len(np.unique(xy // CELL_PX, axis=0)) for xy in (standing, scene))
    return np.asarray(overlay[labels] & (cells <= moving_cells))
