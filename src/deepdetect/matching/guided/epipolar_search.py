"""Sparse matches along known epipolar lines.

A ratio test over the whole image rejects what is repeated anywhere. Once a fundamental matrix is
known, a partner can only lie near a line; what is elsewhere tells how alike wrong partners are.
"""

from __future__ import annotations

import math

import numpy as np

from ...features.keypoints import Keypoints

BLOCK = 500
"""Keypoints of the first image that are compared at once."""

MAX_DISTANCE_PX = 3.0
"""Of each keypoint from the other's line."""

MAX_RATIO_ELSEWHERE = 0.95
"""Of the distance of both descriptors to that of the most similar keypoint far from the line, which
is wrong for sure."""

MAX_RATIO_NEAR = 0.85
"""The same for the second-best near the line."""

MIN_SEPARATION_PX = 5.0
"""Keypoints nearer than this to the best show the same, and are no second-best."""

NULL_SHIFTS = (0.05, 0.1)
"""By how much lines are moved, right, left, down and up, to count what matches by chance, in units
of the longer side of the image."""


def epipolar_search(
    first: Keypoints, second: Keypoints, fundamental: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Match described keypoints near each other's epipolar lines, mutually.

    Returns (M, 2) float64 positions in both images.
    """
    points0, points1 = first.xy.astype(np.float64), second.xy.astype(np.float64)
    if not len(points0) or not len(points1):
        return np.empty((0, 2)), np.empty((0, 2))
    assert first.descriptors is not None
    assert second.descriptors is not None
    described0 = first.descriptors.astype(np.float32)
    described1 = second.descriptors.astype(np.float32)
    squares1 = (described1**2).sum(axis=1)
    ones0, lines1 = _points_and_lines(points0, fundamental)
    ones1, lines0 = _points_and_lines(points1, fundamental.T)
    count = len(points0)
    best = np.full(count, np.inf, np.float32)
    partner = np.zeros(count, np.int64)
    second_best, elsewhere0 = best.copy(), best.copy()
    elsewhere1 = np.full(len(points1), np.inf, np.float32)
    best1, partner1 = elsewhere1.copy(), np.zeros(len(points1), np.int64)
    for start in range(0, count, BLOCK):
        rows = slice(start, min(start + BLOCK, count))
        products = described0[rows] @ described1.T
        squares0 = (described0[rows] ** 2).sum(axis=1)[:, None]
        distance = np.sqrt(np.maximum(squares0 + squares1 - 2 * products, 0))
        near = np.abs(lines1[rows] @ ones1.T) < MAX_DISTANCE_PX
        near &= np.abs(ones0[rows] @ lines0.T) < MAX_DISTANCE_PX
        inside, outside = np.where(near, distance, np.inf), np.where(near, np.inf, distance)
        elsewhere0[rows] = outside.min(axis=1)
        elsewhere1 = np.minimum(elsewhere1, outside.min(axis=0))
        nearest = inside.argmin(axis=0)
        value = inside[nearest, np.arange(len(points1))]
        better = value < best1
        best1[better], partner1[better] = value[better], nearest[better] + start
        nearest = inside.argmin(axis=1)
        best[rows], partner[rows] = inside[np.arange(len(nearest)), nearest], nearest
        offsets = points1 - points1[nearest][:, None]
        apart = np.hypot(offsets[..., 0], offsets[..., 1]) >= MIN_SEPARATION_PX
        second_best[rows] = np.where(apart, inside, np.inf).min(axis=1)
    kept = np.isfinite(best) & (partner1[partner] == np.arange(count))
    kept &= best < MAX_RATIO_ELSEWHERE * np.minimum(elsewhere0, elsewhere1[partner])
    kept &= best < MAX_RATIO_NEAR * second_best
    return points0[kept], points1[partner[kept]]


def _points_and_lines(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return homogeneous points and their epipolar lines, whose products are distances."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    lines = homogeneous @ matrix.T
    length = np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)
    return homogeneous.astype(np.float32), (lines / length[:, None]).astype(np.float32)


def log10_p_value(
    first: Keypoints, second: Keypoints, fundamental: np.ndarray, used: np.ndarray
) -> float:
    """Return the log10 probability that chance explains further matches along epipolar lines.

    `used` are the positions in the first image of those that the matrix was estimated from, right
    or wrong: they are no evidence. Lines at wrong places, the same but moved, find matches by
    chance alone; as many as the right lines find are unlikely among them (a Poisson distribution).
    """
    known = {(float(x), float(y)) for x, y in np.asarray(used, np.float32)}

    def further(matrix: np.ndarray) -> int:
        points0 = epipolar_search(first, second, matrix)[0].astype(np.float32)
        return sum((float(x), float(y)) not in known for x, y in points0)

    side = max(second.image_size)
    by_chance = []
    for share in NULL_SHIFTS:
        for right, down in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            back = np.eye(3)
            back[:2, 2] = -side * share * np.array([right, down])
            by_chance.append(further(back.T @ fundamental))
    expected = max(float(np.mean(by_chance)), 1.0)
    return math.log10(max(_poisson_tail(further(fundamental), expected), 1e-300))


def _poisson_tail(count: int, mean: float) -> float:
    """Return the probability that a Poisson variable is at least `count`."""
    # The terms e^-mean mean^k / k!, as far as they count.
    first = count if count > mean else 0
    last = int(max(count, mean) + 40 * math.sqrt(max(count, mean)) + 40)
    steps = np.log(mean) - np.log(np.arange(first + 1, last + 1))
    start = first * math.log(mean) - mean - math.lgamma(first + 1)
    terms = np.exp(start + np.concatenate([[0.0], np.cumsum(steps)]))
    # Small ones are added up directly, as one less the others would be rounded off.
    return float(terms.sum()) if count > mean else float(max(0.0, 1 - terms[:count].sum()))
