"""Find the uniform frame of an image, and fill pixels that are not part of the scene."""

from __future__ import annotations

import numpy as np

from .._shared.machine import one_opencv_thread
from .._shared.opencv import cv2

MAX_FRAME_NOISE, MIN_RING_SHARE, MIN_FRAME_SHARE, MIN_SCENE_SHARE = 12, 0.05, 0.002, 0.25
MIN_SMOOTH_SHARE, MIN_NOISY_SHARE = 0.75, 0.5
"""Pixels of a frame differ from its colour by at most MAX_FRAME_NOISE grey levels per channel,
about the noise of JPEG. At least MIN_RING_SHARE of the outermost pixels are exactly equal or, in a
noisy frame, MIN_NOISY_SHARE are within that noise. The second rule adds 9 frames in 3,447
photographs, 4 of them real. Each part of a frame covers at least MIN_FRAME_SHARE of the image (one
row of 500), and the scene MIN_SCENE_SHARE, as a portrait video covers 0.32 of a landscape one. The
scene, or each part of the frame, is nearly convex: at least MIN_SMOOTH_SHARE of the outline of its
convex hull lies within FRAME_MARGIN_PX of it. A skyline below a plain sky reaches less."""

FRAME_MARGIN_PX = 8
"""Pixels up to this far from a frame or overlay belong to it, because keypoints there would show
its edge. JPEG spreads an edge over blocks of this side."""

MIN_COMMON = 0.95
"""The uniform frames of two images stand still if their intersection is at least this share of
their union. A flat area does if at least this share of its pixels is equal in all images."""


def uniform_frame(rgb: np.ndarray) -> np.ndarray:
    """Return the (H, W) bool mask of the uniform frame of a (H, W, 3) uint8 image.

    A frame has one colour, reaches the border of the image, and ends in a smooth line: letterbox
    bars, corners of rotated or undistorted images, or the area around a circular fisheye image.
    """
    ring = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    values, counts = np.unique(ring @ np.array([65536, 256, 1]), return_counts=True)
    colour = (values[counts.argmax()] >> np.array([16, 8, 0]) & 255).astype(np.float64)
    exact = counts.max() >= MIN_RING_SHARE * len(ring)
    if not exact:  # a scanned or recompressed frame has noise
        levels = ring.mean(axis=1).astype(int) // (MAX_FRAME_NOISE // 2)
        alike = levels == np.bincount(levels).argmax()
        colour = np.median(ring[alike], axis=0)
    near = (np.abs(ring - colour) <= MAX_FRAME_NOISE).all(axis=1)
    if not exact and near.mean() < MIN_NOISY_SHARE:
        return np.zeros(rgb.shape[:2], bool)
    colour = np.median(ring[near], axis=0)
    with one_opencv_thread():  # OpenCV would exceed the number in OMP_NUM_THREADS
        return _frame_of_colour(rgb, colour, exact)


def _frame_of_colour(rgb: np.ndarray, colour: np.ndarray, exact: bool) -> np.ndarray:
    nowhere = np.zeros(rgb.shape[:2], bool)
    flat = cv2.inRange(rgb, colour - MAX_FRAME_NOISE, colour + MAX_FRAME_NOISE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(flat, connectivity=4)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    areas = stats[:, cv2.CC_STAT_AREA]
    parts = [k for k in border if k and areas[k] >= MIN_FRAME_SHARE * flat.size]
    scene = cv2.morphologyEx(
        (~np.isin(labels, parts)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))
    )
    hull, smooth = _convex_hull(scene)
    frame = ~hull
    if not (smooth and frame.any()):
        if not exact:
            return nowhere
        near = MAX_FRAME_NOISE // 4
        close = cv2.inRange(rgb, colour - near, colour + near) > 0
        # Unlike texture, half of a frame or more is within MAX_FRAME_NOISE / 4 of its colour.
        if 2 * np.count_nonzero(close & np.isin(labels, parts)) < areas[parts].sum():
            return nowhere
        frame = np.isin(
            labels, [k for k in parts if _convex_hull((labels == k).astype(np.uint8))[1]]
        )
    sides = [frame[0].any(), frame[-1].any(), frame[:, 0].any(), frame[:, -1].any()]
    # A sky may be as uniform, but it does not reach all four sides, and is not black.
    if sum(sides) < (4 if colour.any() else 3) or frame.mean() > 1 - MIN_SCENE_SHARE:
        return nowhere
    return widened(frame, FRAME_MARGIN_PX)


def _convex_hull(region: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the convex hull of a region as (H, W) bool, and whether its outline is smooth."""
    hull, outline = np.zeros_like(region), np.zeros_like(region)
    rows = np.flatnonzero(region.any(axis=1))
    if not len(rows):
        return hull > 0, False
    first = region[rows].argmax(axis=1)
    last = region.shape[1] - 1 - region[rows, ::-1].argmax(axis=1)
    ends = np.column_stack([np.append(first, last), np.append(rows, rows)])
    corners = cv2.convexHull(ends.astype(np.int32))
    cv2.fillConvexPoly(hull, corners, 1)
    cv2.polylines(outline, [corners], True, 1)
    inner = outline[1:-1, 1:-1] > 0
    reached = widened(region, FRAME_MARGIN_PX)[1:-1, 1:-1][inner]
    return hull > 0, bool(len(reached) and reached.mean() >= MIN_SMOOTH_SHARE)


def widened(mask: np.ndarray, radius_px: int) -> np.ndarray:
    """Dilate a (H, W) bool mask by `radius_px` in x and in y."""
    side = 2 * radius_px + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def with_flat_parts(overlay: np.ndarray, images: list[np.ndarray]) -> np.ndarray:
    """Extend an (H, W) bool overlay by the areas around it that all (H, W, 3) uint8 images share.

    Flat areas that extend to places where images differ, as paper between letters, are not added.
    """
    equal = (np.ptp(images, axis=0) <= MAX_FRAME_NOISE).all(axis=2)
    steps = cv2.morphologyEx(images[0], cv2.MORPH_GRADIENT, np.ones((3, 3)))
    flat = (steps <= MAX_FRAME_NOISE).all(axis=2)
    areas = cv2.connectedComponents(np.uint8(flat))[1]
    alike = np.bincount(areas.ravel(), equal.ravel()) >= MIN_COMMON * np.bincount(areas.ravel())
    near = np.uint8(overlay | (equal & (alike[areas] | ~flat)))
    near = cv2.morphologyEx(near, cv2.MORPH_OPEN, np.ones([2 * FRAME_MARGIN_PX + 1] * 2))
    labels = cv2.connectedComponents(near)[1]
    return widened(np.isin(labels, labels[overlay]), FRAME_MARGIN_PX)


def filled_smoothly(gray: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace the pixels of a (H, W) uint8 image inside a mask by smooth averages of the others."""
    if not mask.any():
        return gray
    levels = [(gray * np.float32(~mask), np.float32(~mask))]
    while min(levels[-1][1].shape) > 1:
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    values = np.full((1, 1), gray[~mask].mean() if not mask.all() else 0, np.float32)
    for total, weight in reversed(levels):
        coarse = cv2.resize(values, weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
        values = total + coarse * (1 - weight)
    return np.where(mask, np.rint(values).clip(0, 255).astype(np.uint8), gray)
