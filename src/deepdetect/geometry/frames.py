"""Find the uniform frame of an image, and fill what is no part of the scene."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2

MAX_FRAME_NOISE = 12
"""Pixels of a frame differ from its colour by at most this number of grey levels in each channel,
which is about what JPEG leaves."""

MIN_RING_SHARE, MIN_FRAME_SHARE, MIN_SCENE_SHARE = 0.05, 0.002, 0.25
"""A frame has at least the first share of the outermost pixels in exactly its colour. Each part of
it covers the second share of the image, one row of 500. The scene covers the third share; a video
in portrait format covers 0.32 of one in landscape format, a drawing on plain ground often less."""

MAX_RAGGED_PX = 2.0
"""The scene, or each part of the frame, differs from its convex hull by at most this mean distance
in pixels along its outline. A skyline is more ragged."""

FRAME_MARGIN_PX = 8
"""Pixels up to this far from a frame or overlay belong to it, because keypoints there would show
its edge. JPEG spreads an edge over blocks of this side."""


def uniform_frame(rgb: np.ndarray) -> np.ndarray:
    """Return where a (H, W, 3) uint8 image is a uniform frame, (H, W) bool.

    A frame has one colour, reaches the border of the image, and ends in a smooth line: letter
    boxes, corners of rotated or undistorted images, the surroundings of a round lens.
    """
    nowhere = np.zeros(rgb.shape[:2], bool)
    ring = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    values, counts = np.unique(ring @ np.array([65536, 256, 1]), return_counts=True)
    if counts.max() < MIN_RING_SHARE * len(ring):
        return nowhere
    colour = (values[counts.argmax()] >> np.array([16, 8, 0]) & 255).astype(np.float64)
    flat = cv2.inRange(rgb, colour - MAX_FRAME_NOISE, colour + MAX_FRAME_NOISE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(flat, connectivity=4)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    parts = [k for k in border if k and stats[k, cv2.CC_STAT_AREA] >= MIN_FRAME_SHARE * flat.size]
    frame = np.isin(labels, parts)
    if not _is_smooth(~frame):
        frame = np.isin(labels, [k for k in parts if _is_smooth(labels == k)])
    sides = [frame[0].any(), frame[-1].any(), frame[:, 0].any(), frame[:, -1].any()]
    # The sky may be as uniform, but it does not reach all four sides, and is not black.
    if not (all(sides) or not colour.any()) or frame.mean() > 1 - MIN_SCENE_SHARE:
        return nowhere
    return widened(frame, FRAME_MARGIN_PX)


def _is_smooth(region: np.ndarray) -> bool:
    points = cv2.findNonZero(region.astype(np.uint8))
    if points is None:
        return False
    hull = cv2.convexHull(points)
    lacking = np.count_nonzero(cv2.fillConvexPoly(np.zeros(region.shape), hull, 1)) - len(points)
    return bool(lacking <= MAX_RAGGED_PX * cv2.arcLength(hull, True))


def widened(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Return a (H, W) bool mask with all pixels up to `radius_px` away in x and in y."""
    side = 2 * radius_px + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def filled_smoothly(gray: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace the pixels of a (H, W) uint8 image inside a mask by smooth averages of the others."""
    if not mask.any():
        return gray
    levels = [(gray * np.float32(~mask), np.float32(~mask))]
    while min(levels[-1][1].shape) > 1:
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    values = np.zeros((1, 1), np.float32)
    for total, weight in reversed(levels):
        coarse = cv2.resize(values, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        values = total + coarse * (1 - weight)
    return np.where(mask, np.rint(values).clip(0, 255).astype(np.uint8), gray)
