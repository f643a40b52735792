"""Find the uniform frame of an image, and fill what is no part of the scene."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2

MAX_FRAME_NOISE = 12
"""Pixels of a frame differ from its colour by at most this number of grey levels in each channel,
which is what JPEG leaves at the quality of most cameras."""

MIN_FRAME_SHARE = 0.002
"""A connected part of a frame covers at least this share of the image: one row of 500."""

MIN_SCENE_SHARE = 0.25
"""The scene inside a frame covers at least this share of the image. A video in portrait format
covers 0.32 of one in landscape format; a drawing on a plain ground often covers less."""

MIN_RING_SHARE = 0.05
"""At least this share of the outermost pixels has exactly the colour of the frame."""

MAX_RAGGED_PX = 2.0
"""The line between frame and scene, or the parts of the frame, may be this far from convex, as a
mean in pixels. A skyline is more ragged."""

FRAME_MARGIN_PX = 8
"""Pixels up to this distance from a frame or an overlay belong to it, because keypoints there would
show its edge. It is the side of JPEG's blocks, over which an edge spreads."""


def uniform_frame(rgb: np.ndarray) -> np.ndarray | None:
    """Return where a (H, W, 3) uint8 image is a uniform frame, (H, W) bool, or None without one.

    A frame has one colour, reaches the border of the image, and ends in a smooth line: letter
    boxes, corners of rotated or undistorted images, the surroundings of a round lens.
    """
    height, width = rgb.shape[:2]
    ring = np.concatenate([rgb[0], rgb[-1], rgb[1:-1, 0], rgb[1:-1, -1]]).astype(np.int64)
    values, counts = np.unique(ring @ [65536, 256, 1], return_counts=True)
    if counts.max() < MIN_RING_SHARE * len(ring):
        return None
    colour = np.array([values[counts.argmax()] >> shift & 255 for shift in (16, 8, 0)], np.float64)
    low, high = colour - MAX_FRAME_NOISE, colour + MAX_FRAME_NOISE
    flat = cv2.inRange(rgb, low, high)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(flat, connectivity=4)
    border = np.unique([*labels[0], *labels[-1], *labels[:, 0], *labels[:, -1]])
    area = stats[:, cv2.CC_STAT_AREA]
    parts = [k for k in border if k and area[k] >= MIN_FRAME_SHARE * flat.size]
    frame = np.isin(labels, parts)
    if not _is_smooth(~frame):
        frame = np.isin(labels, [k for k in parts if _is_smooth(labels == k)])
    sides = [frame[0], frame[-1], frame[:, 0], frame[:, -1]]
    # The sky may be as uniform, but it does not reach all four sides, and is not black.
    if not all(side.any() for side in sides) and colour.any():
        return None
    if not 0 < frame.mean() <= 1 - MIN_SCENE_SHARE:
        return None
    return widened(frame, FRAME_MARGIN_PX)


def _is_smooth(region: np.ndarray) -> bool:
    """Return whether the outline of a region is nearly its convex hull."""
    y, x = np.nonzero(region)
    if not len(x):
        return False
    hull = cv2.convexHull(np.column_stack([x, y]).astype(np.int32))
    filled = cv2.fillConvexPoly(np.zeros(region.shape, np.uint8), hull, 1)
    lacking = np.count_nonzero(filled) - len(x)
    return bool(lacking <= MAX_RAGGED_PX * cv2.arcLength(hull, True))


def widened(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Return a (H, W) bool mask with all pixels up to `radius_px` away in x and in y."""
    side = 2 * radius_px + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def filled_smoothly(gray: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace the pixels of a (H, W) uint8 image inside a mask by smooth averages of the others."""
    known = np.float32(~mask)
    levels = [(gray * known, known)]
    while min(levels[-1][1].shape) > 1 and (levels[-1][1] == 0).any():
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    total, weight = levels.pop()
    values = total / np.maximum(weight, 1e-6)
    for total, weight in reversed(levels):
        coarse = cv2.pyrUp(values, dstsize=total.shape[::-1])
        own = total / np.maximum(weight, 1e-6)
        values = np.where(weight > 0, own * weight + coarse * (1 - weight), coarse)
    return np.where(mask, np.rint(values).clip(0, 255).astype(np.uint8), gray)
