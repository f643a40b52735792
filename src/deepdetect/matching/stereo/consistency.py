"""Which disparities of a map can be trusted, and how gaps between surfaces are filled.

Maps are (H, W): `disparity` float32 in pixels, `known` bool.
"""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2

MAX_DIFFERENCE_PX = 1.0
"""A disparity that differs by more from its neighbour's belongs to another surface."""

SUBDIVISIONS = 4
"""Parts of a pixel in which OpenCV's speckle filter counts."""


OCCLUSION_SLACK_PX = 8
"""By which a gap may be wider than the step of disparity explains: the windows on both sides."""


def filter_speckles(disparity: np.ndarray, known: np.ndarray, max_area_px: int) -> np.ndarray:
    """Return the known pixels without patches of at most so many pixels: most of these are wrong.

    A patch is connected by steps of at most twice `MAX_DIFFERENCE_PX`.

    Example:
        >>> disparity = np.zeros((20, 20), np.float32)
        >>> disparity[5:8, 5:8] = 7
        >>> int(filter_speckles(disparity, disparity >= 0, 10).sum())
        391
    """
    invalid = np.iinfo(np.int16).min
    steps = np.where(known, np.rint(disparity * SUBDIVISIONS), invalid).astype(np.int16)
    cv2.filterSpeckles(steps, invalid, max_area_px, round(2 * MAX_DIFFERENCE_PX * SUBDIVISIONS))
    return known & (steps != invalid)


def near_discontinuity(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Find the pixels this near to a disparity discontinuity, along rows, columns or both.

    The window of a match there sees both surfaces, and gives a pixel beside the nearer one its
    disparity. Where nothing is known, the farther of both sides is assumed to continue.

    Example:
        >>> disparity = np.zeros((5, 9), np.float32)
        >>> disparity[:, 4:] = 3
        >>> near_discontinuity(disparity, disparity >= 0, 1)[0].astype(int)
        array([0, 0, 1, 1, 1, 1, 0, 0, 0])
    """
    filled = fill_occlusions(disparity, known)[0]
    near = np.zeros(disparity.shape, np.uint8)
    across = np.abs(np.diff(filled, axis=1)) > MAX_DIFFERENCE_PX
    along = np.abs(np.diff(filled, axis=0)) > MAX_DIFFERENCE_PX
    near[:, 1:] |= across
    near[:, :-1] |= across
    near[1:] |= along
    near[:-1] |= along
    side = 2 * distance_px + 1
    return cv2.dilate(near, np.ones((side, side), np.uint8)) > 0


def on_occluding_edge(disparity: np.ndarray, known: np.ndarray, distance_px: int) -> np.ndarray:
    """Find the outermost known pixels of surfaces in front of others, as wide as `distance_px`.

    The windows of the match give the nearer disparity also to what lies just beside it, so these
    are the least sure of all. Where nothing is known, the farther of both sides is assumed to
    continue.

    Example:
        >>> disparity = np.zeros((5, 9), np.float32)
        >>> disparity[:, 4:] = 3
        >>> on_occluding_edge(disparity, disparity >= 0, 1)[0].astype(int)
        array([0, 0, 0, 0, 1, 0, 0, 0, 0])
    """
    filled = fill_occlusions(disparity, known)[0]
    side = 2 * distance_px + 1
    farthest = cv2.erode(filled, np.ones((side, side), np.uint8))
    return known & (filled - farthest > MAX_DIFFERENCE_PX)


def fill_occlusions(disparity: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown pixels with the farther of the nearest known ones on both sides of their row.

    What the right view does not see lies behind what occludes it.

    Returns:
        (H, W) float32 disparity, 0 in rows where nothing is known; and (H, W) bool, true where
        both sides are known and the gap is no wider than what the nearer surface can occlude.
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
