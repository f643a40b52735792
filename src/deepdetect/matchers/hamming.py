"""Exact search by Hamming's distance, for binary descriptors as ORB's and BRISK's."""

from __future__ import annotations

import cv2
import numpy as np

from ..errors import OptionError

BLOCK = 20_000
"""Queries at a time: OpenCV keeps an object for each of their neighbours."""


def hamming_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbours by the number of differing bits.

    Args:
        queries: (N, D) uint8 descriptors.
        base: (M, D) uint8 descriptors, M >= count.
        count: neighbours of each query.
        seed: not used; all matchers take the same arguments.

    Returns:
        (N, count) int32 rows of `base` and (N, count) float32 distances, the nearest first.

    Raises:
        OptionError: the descriptors are not binary.
    """
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher hamming compares binary descriptors, as ORB's: take exact or flann"
        )
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    rows = np.empty((len(queries), count), np.int32)
    distances = np.empty((len(queries), count), np.float32)
    for start in range(0, len(queries), BLOCK):
        found = matcher.knnMatch(queries[start : start + BLOCK], base, count)
        rows[start : start + BLOCK] = [[one.trainIdx for one in some] for some in found]
        distances[start : start + BLOCK] = [[one.distance for one in some] for some in found]
    return rows, distances
