"""A homography that fits most of the image well, where none fits all of it.

What takes all pixels at once (`photometric_refinement`) is the best compromise. A lens that bends
lines, or a wall that is not quite flat, can make that wrong by a pixel nearly everywhere. A robust
fit to tracked corners then lies right on most of the image, and leaves the rest further off. Which
of the two is better is measured: by the share of pixels that are in place.
"""

from __future__ import annotations

import cv2
import numpy as np

from .homography_refinement import RefinementOptions, tracked_corners
from .residuals import transform_points
from .zncc import warp_back

IN_PLACE = 0.5
"""A pixel is in place when what is around it lies at most so far off, in pixels."""

MORE = 1.1
"""The fit to the majority is taken when it puts so many times as many pixels in place."""

WINDOW = 31
"""Side of the tracked windows in pixels."""

SURROUNDINGS = 41
"""Side in pixels of the window around a pixel that says how far off it lies."""

SCALE = 1.0
"""Of Cauchy's weights in pixels: corners so far off have half the say."""

ROUNDS = 30


def fit_to_majority(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Return the homography given, or one that puts clearly more pixels in place.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        homography: (3, 3) from the first image to the second, right within some pixels.

    Returns:
        (3, 3), its last element 1.
    """
    size = (gray0.shape[1], gray0.shape[0])
    warped, seen = warp_back(gray1, homography, size)
    corners = tracked_corners(gray0, warped, seen, WINDOW, RefinementOptions())
    if corners is None:
        return homography
    correction = robust_homography(*corners)
    if correction is None:
        return homography
    candidate = homography @ correction
    before = share_in_place(gray0, warped, seen)
    after = share_in_place(gray0, *warp_back(gray1, candidate, size))
    return candidate / candidate[2, 2] if after > MORE * before else homography


def robust_homography(points0: np.ndarray, points1: np.ndarray) -> np.ndarray | None:
    """Fit a homography by iteratively reweighted least squares with Cauchy's weights.

    Args:
        points0, points1: (N, 2), most of them at most some pixels from where they were.

    Returns:
        (3, 3), its last element 1; None when the points do not determine it.

    Example:
        >>> points = np.array([[0, 0], [9, 0], [9, 9], [0, 9], [4, 5.0]])
        >>> robust_homography(points, points + (2, -1)).round(6)[:2, 2].tolist()
        [2.0, -1.0]
    """
    if len(points0) < 4:
        return None
    middle = points0.mean(axis=0)
    spread = float(np.abs(points0 - middle).mean())
    if not spread > 0:
        return None
    inwards = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, spread]]) / spread
    first, second = ((points - middle) / spread for points in (points0, points1))
    homography = np.eye(3)
    for _ in range(ROUNDS):
        depth = first @ homography[2, :2] + 1
        mapped = transform_points(first, homography)
        gaps = second - mapped
        weight = 1 / (1 + (gaps**2).sum(axis=1) * (spread / SCALE) ** 2)
        place = np.column_stack([first, np.ones(len(first))]) / depth[:, None]
        none = np.zeros_like(place)
        across = np.column_stack([place, none, -mapped[:, :1] * place[:, :2]])
        down = np.column_stack([none, place, -mapped[:, 1:] * place[:, :2]])
        normal = (across.T * weight) @ across + (down.T * weight) @ down
        right = (across.T * weight) @ gaps[:, 0] + (down.T * weight) @ gaps[:, 1]
        try:
            step = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        homography = homography + np.append(step, 0).reshape(3, 3)
        if np.abs(step).max() < 1e-9:
            break
    found = np.linalg.inv(inwards) @ homography @ inwards
    return found / found[2, 2]


def share_in_place(gray0: np.ndarray, warped: np.ndarray, seen: np.ndarray) -> float:
    """Return the share of the seen pixels that lie at most `IN_PLACE` px off.

    How far is one step of Lucas-Kanade's at each pixel, over a window, after both images are
    equalised.

    Args:
        gray0, warped: (H, W) uint8.
        seen: (H, W) bool, where the second has content.
    """
    if not seen.any():
        return 0.0
    equalise = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply
    first, second = (
        cv2.GaussianBlur(equalise(gray).astype(np.float32), (0, 0), 1) for gray in (gray0, warped)
    )
    x, y = (cv2.Scharr(first, cv2.CV_32F, *order) / 32 for order in ((1, 0), (0, 1)))
    window = (SURROUNDINGS, SURROUNDINGS)
    change = second - first
    change -= cv2.blur(change, window)
    xx, xy, yy, xt, yt = (
        cv2.blur(product, window) for product in (x * x, x * y, y * y, x * change, y * change)
    )
    determinant = xx * yy - xy * xy + 1e-3
    off = np.hypot(yy * xt - xy * yt, xx * yt - xy * xt) / determinant
    return float((off[seen] <= IN_PLACE).mean())
