"""Dense matches of a scene with depth: the most alike keypoint near the epipolar line.

The line leaves one direction open, so a partner is searched (`matchers.patchmatch`) in both
images, and a pair stays when each is the other's best or beside it, when the pairs around it move
alike, when both places look alike by more than strangers do, and when many of the keypoints
around it are matched: of those under something that only one image shows a few find a partner.
"""

from __future__ import annotations

import cv2
import numpy as np

from ...features.dense_sift import dense_sift
from ...features.matchers.patchmatch import epipolar_neighbours
from ...features.sift import to_root_sift

SIZE = 2.0
"""Diameter of the keypoints for the search, in pixels: small, as depth jumps within a large one."""

BAND = 1.5
"""Pixels from the epipolar line."""

RETURN = 1.0
"""Pixels from a keypoint to the best partner of its best partner."""

AROUND = 15
"""Side in pixels of the window in which pairs must move alike."""

ALIKE = 1.5
"""Pixels by which the motions of neighbours may differ."""

SHARE = 0.8
"""Share of the pairs in the window that must move so."""

CROWD = 31
MATCHED = 0.35
USUAL = 0.5
"""Side in pixels of the window around a pair, the share of its keypoints that must be matched, and
the share of what is usual in this image that is enough: scattered keypoints are matched less."""

STRANGERS = 0.02
"""Share of pairs of places that have nothing to do with each other that would pass."""

SAMPLE = 20_000


def matches_by_epipolar_line(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    fundamental: np.ndarray,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Match keypoints by a fundamental matrix, and keep those that look and move alike.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        fundamental: (3, 3) with x1^T F x0 = 0.
        seed: of the search, and of the choice of strangers.

    Returns:
        (K,) rows of the first and of the second keypoints, and the distance of their
        descriptors over that of strangers, under 1.
    """
    nothing = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.float32)
    if len(xy0) < 2 or len(xy1) < 2:
        return nothing
    first, second = (
        to_root_sift(dense_sift(gray, xy, SIZE), overwrite=True)
        for gray, xy in ((gray0, xy0), (gray1, xy1))
    )
    there, distances = epipolar_neighbours(first, second, seed, (xy0, xy1), fundamental, BAND)
    back, _ = epipolar_neighbours(second, first, seed, (xy1, xy0), fundamental.T, BAND)
    # Nearly each other's best: dense keypoints have equally good ones beside them.
    returned = np.linalg.norm(np.asarray(xy0)[back[there]] - np.asarray(xy0), axis=1)
    mutual = np.isfinite(distances) & (returned <= RETURN)
    rows0 = np.flatnonzero(mutual)
    if not len(rows0):
        return nothing
    rows1 = there[rows0].astype(np.int64)
    ratios = distances[rows0] / _strange_distance(first, second, seed)
    kept = ratios < 1
    rows0, rows1, ratios = rows0[kept], rows1[kept], ratios[kept]
    kept = move_alike(xy0[rows0], xy1[rows1], gray0.shape)
    rows0, rows1, ratios = rows0[kept], rows1[kept], ratios[kept]
    kept = in_crowd(xy0[rows0], xy0, gray0.shape)
    return rows0[kept], rows1[kept], ratios[kept]


def move_alike(points0: np.ndarray, points1: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Tell which pairs move as those around them do.

    Args:
        points0: (N, 2) whole pixels of the first image, each once.
        points1: (N, 2) their partners.
        shape: (H, W) of the first image.

    Returns:
        (N,) bool: at least `SHARE` of the other pairs in the window move within `ALIKE` pixels
        of it in x and in y, and there is one.
    """
    pixels = np.asarray(points0).astype(np.int64)
    motion = (np.asarray(points1) - points0).astype(np.float32)
    flow = np.full((*shape[:2], 2), np.nan, np.float32)
    flow[pixels[:, 1], pixels[:, 0]] = motion
    reach = AROUND // 2
    padded = cv2.copyMakeBorder(
        flow, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=(np.nan, np.nan)
    )
    others, alike = np.zeros(len(pixels), np.int32), np.zeros(len(pixels), np.int32)
    for down in range(AROUND):
        for across in range(AROUND):
            if down == across == reach:
                continue
            there = padded[pixels[:, 1] + down, pixels[:, 0] + across]
            others += np.isfinite(there[:, 0])
            alike += (np.abs(there - motion) <= ALIKE).all(1)
    return alike >= np.maximum(SHARE * others, 1)


def in_crowd(points: np.ndarray, keypoints: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Tell which matched points lie where many keypoints are matched.

    Args:
        points: (N, 2) whole pixels of the first image that are matched, each once.
        keypoints: (M, 2) all its keypoints.
        shape: (H, W) of the first image.

    Returns:
        (N,) bool: at least a share `MATCHED` of the keypoints in the window is matched, or the
        share `USUAL` of the median over all points where that is less.
    """
    if not len(points):
        return np.empty(0, bool)
    matched, everything = (np.asarray(xy).astype(np.int64) for xy in (points, keypoints))
    counts = []
    for xy in (matched, everything):
        image = np.zeros(tuple(shape[:2]), np.float32)
        image[xy[:, 1], xy[:, 0]] = 1
        counts.append(
            cv2.boxFilter(
                image, -1, (CROWD, CROWD), normalize=False, borderType=cv2.BORDER_CONSTANT
            )[matched[:, 1], matched[:, 0]]
        )
    shares = counts[0] / np.maximum(counts[1], 1)
    return shares >= min(MATCHED, USUAL * float(np.median(shares)))


def _strange_distance(first: np.ndarray, second: np.ndarray, seed: int) -> float:
    """Return the distance that a share of `STRANGERS` of random pairs stays under."""
    generator = np.random.default_rng(seed)
    sample = [
        part[generator.integers(0, len(part), SAMPLE)].astype(np.float32)
        for part in (first, second)
    ]
    distances = np.linalg.norm(sample[0] - sample[1], axis=1)
    return max(float(np.quantile(distances, STRANGERS)), 1e-6)
