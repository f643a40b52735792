"""Exact search: every descriptor is compared, by Euclidean or Hamming distance."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.opencv import cv2

BLOCK_SIZE = 4_000_000
"""Numbers of four bytes that exact search holds at a time: 16 MB, most of which caches hold."""

MAX_EXACT_BYTES = 2**24 // (2 * 255**2)
"""Length of descriptors of bytes up to which single precision computes distances exactly."""

HAMMING_QUERIES = 20_000
"""At a time: OpenCV keeps an object for each of their neighbours."""

HAMMING_BASE = 200_000
"""At a time: OpenCV's search takes fewer than 2^18."""


def exact_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find the true nearest neighbours by matrix products, as a `Matcher`; of equals the lower row.

    The time grows with the product of the numbers: meant for tens of thousands.
    """
    rows = np.empty((len(queries), count), np.int32)
    distances = np.empty((len(queries), count), np.float32)
    # The expansion below loses digits where distances are small: double precision, but for bytes,
    # whose sums are whole numbers that single precision holds.
    whole = queries.dtype == base.dtype == np.uint8 and queries.shape[1] <= MAX_EXACT_BYTES
    precision: type[np.floating[Any]] = np.float32 if whole else np.float64
    queries, base = (np.asarray(part, np.float32) for part in (queries, base))
    # |q - b|^2 without the constant |q|^2, as one product: (-2 q, 1) (b, |b|^2).
    length = base.shape[1]
    wide = np.empty((length + 1, len(base)), precision)
    wide[:length] = base.T
    np.einsum("ij,ij->j", wide[:length], wide[:length], out=wide[length])
    step = max(1, BLOCK_SIZE // max(len(base) * wide.itemsize // 4, 2 * count * length))
    for start in range(0, len(queries), step):
        block = queries[start : start + step]
        factors = np.ones((len(block), length + 1), precision)
        np.multiply(block, -2, out=factors[:, :length])
        partial = factors @ wide
        found = np.empty((len(block), count), np.intp)
        every = np.arange(len(block))
        for rank in range(count):  # argmin takes the lower row of equals
            found[:, rank] = partial.argmin(1)
            partial[every, found[:, rank]] = np.inf
        found.sort(axis=1)
        # From the differences themselves, so that distances are exact near 0.
        gaps = np.linalg.norm(block[:, None] - base[found], axis=2)
        order = np.argsort(gaps, axis=1, kind="stable")
        rows[start : start + step] = np.take_along_axis(found, order, 1)
        distances[start : start + step] = np.take_along_axis(gaps, order, 1)
    return rows, distances


def hamming_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find nearest neighbours of binary descriptors (ORB, BRISK) by Hamming, as a `Matcher`.

    Raises:
        OptionError: the descriptors are not binary.
    """
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher hamming compares binary descriptors, such as ORB's: use exact or flann"
        )
    rows = np.empty((len(queries), count), np.int32)
    distances = np.empty((len(queries), count), np.float32)
    for start in range(0, len(queries), HAMMING_QUERIES):
        some = queries[start : start + HAMMING_QUERIES]
        parts = [
            _search_part(some, base[first : first + HAMMING_BASE], count, first)
            for first in range(0, len(base), HAMMING_BASE)
        ]
        candidates, gaps = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
        order = np.argsort(gaps, axis=1, kind="stable")[:, :count]
        rows[start : start + HAMMING_QUERIES] = np.take_along_axis(candidates, order, 1)
        distances[start : start + HAMMING_QUERIES] = np.take_along_axis(gaps, order, 1)
    return rows, distances


def _search_part(
    queries: np.ndarray, base: np.ndarray, count: int, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Search a part of the base, whose first row has the number `first`."""
    found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(queries, base, min(count, len(base)))
    rows = np.array([[one.trainIdx for one in some] for some in found], np.int32)
    return rows + first, np.array([[one.distance for one in some] for some in found], np.float32)
