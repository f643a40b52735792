"""Exact search by Hamming's distance, for binary descriptors as ORB's and BRISK's."""

from __future__ import annotations

import cv2
import numpy as np

from ..._shared.errors import OptionError

QUERIES = 20_000
"""At a time: OpenCV keeps an object for each of their neighbours."""

BASE = 200_000
"""At a time: OpenCV's search takes fewer than 2^18."""


def hamming_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbours by the number of differing bits.

    Args:
        queries: (N, D) uint8 descriptors.
        base: (M, D) uint8 descriptors, M >= count.
        count: neighbours of each query.
        seed, positions: not used; all matchers take the same arguments.

    Returns:
        (N, count) int32 rows of `base` and (N, count) float32 distances, the nearest first.

    Raises:
        OptionError: the descriptors are not binary.
    """
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher hamming compares binary descriptors, as ORB's: take exact or flann"
        )
    rows = np.empty((len(queries), count), np.int32)
    distances = np.empty((len(queries), count), np.float32)
    for start in range(0, len(queries), QUERIES):
        some = queries[start : start + QUERIES]
        parts = [
            _search(some, base[first : first + BASE], count, first)
            for first in range(0, len(base), BASE)
        ]
        candidates, gaps = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        order = np.argsort(gaps, axis=1, kind="stable")[:, :count]
        rows[start : start + QUERIES] = np.take_along_axis(candidates, order, 1)
        distances[start : start + QUERIES] = np.take_along_axis(gaps, order, 1)
    return rows, distances


def _search(
    queries: np.ndarray, base: np.ndarray, count: int, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Search a part of the base, whose first row has the number `first`."""
    found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(queries, base, min(count, len(base)))
    rows = np.array([[one.trainIdx for one in some] for some in found], np.int32)
    return rows + first, np.array([[one.distance for one in some] for some in found], np.float32)
