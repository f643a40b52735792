"""Dense matches of a plane or a turning camera: the keypoint nearest to where it must be."""

from __future__ import annotations

import numpy as np

from ...geometry.residuals import transform_points
from ...geometry.zncc import warp_to_reference
from .verification import unlikeness

REACH = 1.0
"""A keypoint matches when it is nearer than this to where the homography takes the other."""


def matches_by_homography(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    homography: np.ndarray,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match keypoints by a homography, and keep those that look alike.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        homography: (3, 3) from the first image to the second.
        seed: of the test of likeness.

    Returns:
        (K,) rows of the first and of the second keypoints, and their `unlikeness`, under 1. A
        keypoint of the second image may have several partners: each of the first counts once.
    """
    places = transform_points(xy0, homography)
    rows1, distances = nearest_pixel(places, xy1, (gray1.shape[1], gray1.shape[0]))
    rows0 = np.flatnonzero(distances < REACH)
    if not len(rows0):
        return rows0, rows0, np.empty(0, np.float32)
    warped, seen = warp_to_reference(gray1, homography, (gray0.shape[1], gray0.shape[0]))
    scores = unlikeness(gray0, warped, seen, xy0[rows0], seed)
    kept = rows0[scores < 1]
    return kept, rows1[kept], scores[scores < 1]


def nearest_pixel(
    places: np.ndarray, xy: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the keypoint nearest to each place, of those in the 3x3 pixels around it.

    Args:
        places: (N, 2) positions.
        xy: (M, 2) keypoints on whole pixels.
        size: (width, height) of their image.

    Returns:
        (N,) rows of `xy` and (N,) distances, infinite where there is none so near.

    Example:
        >>> rows, far = nearest_pixel(np.array([[2.2, 3.0], [9, 9]]), np.array([[2, 3]]), (10, 10))
        >>> rows[0], far.round(2).tolist()
        (np.int32(0), [0.2, inf])
    """
    width, height = size
    grid = np.full((height + 4, width + 4), -1, np.int32)  # two pixels of border
    pixels = np.asarray(xy).astype(np.int64)
    grid[pixels[:, 1] + 2, pixels[:, 0] + 2] = np.arange(len(pixels))
    inside = (
        np.isfinite(places).all(1) & (places > -1.5).all(1) & (places < np.array(size) + 0.5).all(1)
    )
    middle = np.rint(np.where(inside[:, None], places, 0)).astype(np.int64)
    rows = np.full(len(places), -1, np.int32)
    best = np.full(len(places), np.inf)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            x, y = middle[:, 0] + across, middle[:, 1] + down
            found = grid[y + 2, x + 2]
            gap = np.hypot(x - places[:, 0], y - places[:, 1])
            nearer = inside & (found >= 0) & (gap < best)
            rows[nearer], best[nearer] = found[nearer], gap[nearer]
    return rows, best
