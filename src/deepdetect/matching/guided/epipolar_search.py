"""Sparse matches along known epipolar lines.

A ratio test over the whole image rejects repeated structure. So the ratio test here compares only
the keypoints near the epipolar line, where the partner must lie. Keypoints far from the line show
how similar wrong matches are.
"""

from __future__ import annotations

import math

import numpy as np

from ..._shared.kernels import compiled
from ...features.keypoints import Keypoints
from ...geometry.transforms import translation_matrix

MAX_DISTANCE_PX = 3.0
"""Maximum distance of a keypoint from the epipolar line of its partner. Chosen by hand."""

MAX_RATIO_ELSEWHERE = 0.95
"""The descriptor distance of a match must be below this fraction of the distance to the most
similar keypoint far from the epipolar line, which is certainly wrong. Chosen by hand."""

MAX_RATIO_NEAR = 0.85
"""Maximum ratio in the ratio test among the keypoints near an epipolar line. Chosen by hand."""

MIN_SEPARATION_PX = 5.0
"""The ratio test near the line ignores keypoints closer than this to the best match, because these
keypoints show the same place. Chosen by hand."""

NULL_SHIFTS = (0.05, 0.1)
"""Chance matches are counted along epipolar lines shifted by these fractions of the longer side of
the second image. Chosen by hand."""


def epipolar_search(
    first: Keypoints, second: Keypoints, fundamental: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Match keypoints one to one by their descriptors, only near each other's epipolar lines.

    Returns the positions of the matches, (M, 2) float64 in each image.
    """
    return _search(first, second, _squared_distances(first, second), fundamental)


def _squared_distances(first: Keypoints, second: Keypoints) -> np.ndarray:
    """Return (N, M) float32 squared distances between the descriptors."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    described0 = first.descriptors.astype(np.float32)
    described1 = second.descriptors.astype(np.float32)
    squares0, squares1 = ((each**2).sum(axis=1) for each in (described0, described1))
    distances = described0 @ described1.T
    distances *= -2
    distances += squares0[:, None]
    distances += squares1
    return np.maximum(distances, 0, out=distances)


def _search(
    first: Keypoints, second: Keypoints, distances: np.ndarray, fundamental: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    points0, points1 = first.xy.astype(np.float64), second.xy.astype(np.float64)
    if not len(points0) or not len(points1):
        return np.empty((0, 2)), np.empty((0, 2))
    ones0, lines1 = _points_and_lines(points0, fundamental)
    ones1, lines0 = _points_and_lines(points1, fundamental.T)
    geometry = ones0, lines1, ones1, lines0
    separation = MIN_SEPARATION_PX**2
    partner0, least, rival, elsewhere0, partner1, elsewhere1 = _nearest_on_lines(
        distances, *geometry, MAX_DISTANCE_PX, separation
    )
    kept = np.isfinite(least) & (partner1[partner0] == np.arange(len(points0)))
    kept &= least < MAX_RATIO_ELSEWHERE**2 * np.minimum(elsewhere0, elsewhere1[partner0])
    kept &= least < MAX_RATIO_NEAR**2 * rival
    return points0[kept], points1[partner0[kept]]


@compiled(nogil=True)
def _nearest_on_lines(distances, ones0, lines1, ones1, lines0, max_distance, separation):  # type: ignore[no-untyped-def]
    """Find the partner of each keypoint: the most similar keypoint near its epipolar line.

    Returns, for each keypoint of the first image, the index of its partner and three squared
    descriptor distances: to the partner, to the best other keypoint near the line, and to the best
    one far from it. For the second image, returns partners and distances far from the lines.
    """
    count0, count1 = distances.shape
    partner0, partner1 = np.zeros(count0, np.int64), np.zeros(count1, np.int64)
    least0 = np.full(count0, np.inf, np.float32)
    rival, elsewhere0 = least0.copy(), least0.copy()
    least1 = np.full(count1, np.inf, np.float32)
    elsewhere1 = least1.copy()
    near = np.empty(count1, np.int64)
    for i in range(count0):
        u0, v0, a1, b1, c1 = ones0[i, 0], ones0[i, 1], lines1[i, 0], lines1[i, 1], lines1[i, 2]
        found = 0
        for j in range(count1):
            value = distances[i, j]
            off1 = abs(a1 * ones1[j, 0] + b1 * ones1[j, 1] + c1)
            if off1 < max_distance:
                off0 = abs(lines0[j, 0] * u0 + lines0[j, 1] * v0 + lines0[j, 2])
                if off0 < max_distance:
                    near[found] = j
                    found += 1
                    if value < least0[i]:
                        least0[i], partner0[i] = value, j
                    if value < least1[j]:
                        least1[j], partner1[j] = value, i
                    continue
            elsewhere0[i] = min(elsewhere0[i], value)
            elsewhere1[j] = min(elsewhere1[j], value)
        x, y = ones1[partner0[i], 0], ones1[partner0[i], 1]
        for j in near[:found]:
            apart = (ones1[j, 0] - x) ** 2 + (ones1[j, 1] - y) ** 2 >= separation
            if apart and distances[i, j] < rival[i]:
                rival[i] = distances[i, j]
    return partner0, least0, rival, elsewhere0, partner1, elsewhere1


def _points_and_lines(points: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return homogeneous points, (N, 3), and their epipolar lines, (N, 3), with unit normals."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    lines = homogeneous @ matrix.T
    length = np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)
    return homogeneous.astype(np.float32), (lines / length[:, None]).astype(np.float32)


def log10_p_value(
    first: Keypoints, second: Keypoints, fundamental: np.ndarray, used: np.ndarray
) -> float:
    """Return the log10 of the probability that chance explains the new matches on epipolar lines.

    Matches are new unless their positions in the first image are in `used`, the (M, 2) positions
    from which the fundamental matrix was estimated. Matches on shifted lines arise by chance. Their
    mean number, as the mean of a Poisson distribution, gives the probability.
    """
    distances = _squared_distances(first, second)
    known = {(float(x), float(y)) for x, y in np.asarray(used, np.float32)}

    def further(matrix: np.ndarray) -> int:
        points0 = _search(first, second, distances, matrix)[0].astype(np.float32)
        return sum((float(x), float(y)) not in known for x, y in points0)

    side = max(second.image_size)
    by_chance = []
    for share in NULL_SHIFTS:
        for right, down in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            back = translation_matrix(-side * share * right, -side * share * down)
            by_chance.append(further(back.T @ fundamental))
    expected = max(float(np.mean(by_chance)), 1.0)
    return math.log10(max(_poisson_tail(further(fundamental), expected), 1e-300))


def _poisson_tail(count: int, mean: float) -> float:
    """Return the probability that a Poisson variable is at least `count`."""
    # Only the terms e^-mean mean^k / k! that are not negligible are computed.
    first = count if count > mean else 0
    last = int(max(count, mean) + 40 * math.sqrt(max(count, mean)) + 40)
    steps = np.log(mean) - np.log(np.arange(first + 1, last + 1))
    start = first * math.log(mean) - mean - math.lgamma(first + 1)
    terms = np.exp(start + np.concatenate([[0.0], np.cumsum(steps)]))
    # A small tail is summed directly, because 1 minus the other terms would lose it in rounding.
    return float(terms.sum()) if count > mean else float(max(0.0, 1 - terms[:count].sum()))
