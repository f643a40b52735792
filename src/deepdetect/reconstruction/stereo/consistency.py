"""Which disparities of a map can be trusted, and what is behind an edge."""

from __future__ import annotations

import cv2
import numpy as np

JUMP = 1.0
"""Pixels; a disparity that differs by more from its neighbour's is on another surface."""

SLACK = 8
"""Pixels that a gap may be wider than what hides it: the windows on both sides reach so far."""

SUBDIVISIONS = 4
"""Parts of a pixel in which OpenCV's filter of speckles counts."""


def without_islands(disparity: np.ndarray, known: np.ndarray, size: int) -> np.ndarray:
    """Leave out small patches that differ in disparity from all around: most are wrong.

    Args:
        disparity: (H, W) float32 in pixels.
        known: (H, W) bool.
        size: pixels; patches of at most so many are left out.

    Returns:
        (H, W) bool, the known pixels without them.

    Example:
        >>> disparity = np.zeros((20, 20), np.float32)
        >>> disparity[5:8, 5:8] = 7
        >>> int(without_islands(disparity, disparity >= 0, 10).sum())
        391
    """
    nothing = np.iinfo(np.int16).min
    steps = np.where(known, np.rint(disparity * SUBDIVISIONS), nothing).astype(np.int16)
    cv2.filterSpeckles(steps, nothing, size, round(2 * JUMP * SUBDIVISIONS))
    return known & (steps != nothing)


def depth_edges(disparity: np.ndarray, known: np.ndarray, distance: int) -> np.ndarray:
    """Find the pixels near a jump of depth.

    The window of a match there sees both surfaces, and gives a pixel beside the nearer one its
    disparity. Where nothing is known, the farther of both sides is taken to go on.

    Args:
        disparity: (H, W) float32 in pixels.
        known: (H, W) bool.
        distance: in pixels, along rows, columns or both.

    Returns:
        (H, W) bool.

    Example:
        >>> disparity = np.zeros((5, 9), np.float32)
        >>> disparity[:, 4:] = 3
        >>> depth_edges(disparity, disparity >= 0, 1)[0].astype(int)
        array([0, 0, 1, 1, 1, 1, 0, 0, 0])
    """
    whole = behind(disparity, known)[0]
    near = np.zeros(disparity.shape, np.uint8)
    across = np.abs(np.diff(whole, axis=1)) > JUMP
    along = np.abs(np.diff(whole, axis=0)) > JUMP
    near[:, 1:] |= across
    near[:, :-1] |= across
    near[1:] |= along
    near[:-1] |= along
    side = 2 * distance + 1
    return cv2.dilate(near, np.ones((side, side), np.uint8)) > 0


def behind(disparity: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown pixels with the farther of the nearest known ones on both sides of their row.

    What the right view does not see lies behind what hides it.

    Args:
        disparity: (H, W) float32 in pixels.
        known: (H, W) bool.

    Returns:
        (H, W) float32 disparity, 0 in rows where nothing is known; and (H, W) bool, where there
        is something known on both sides, and the gap is no wider than what the nearer surface
        can hide.
    """
    width = disparity.shape[1]
    column = np.arange(width)
    left = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    right = np.minimum.accumulate(np.where(known, column, width)[:, ::-1], axis=1)[:, ::-1]
    one, other = (
        np.take_along_axis(disparity, np.clip(at, 0, width - 1), axis=1) for at in (left, right)
    )
    at_left, at_right = left >= 0, right < width
    farther = np.where(at_left & at_right, np.minimum(one, other), np.where(at_left, one, other))
    hidden = right - left - 1 <= np.abs(one - other) + SLACK
    return np.where(at_left | at_right, farther, np.float32(0)), at_left & at_right & hidden
