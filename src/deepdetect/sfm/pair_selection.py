"""Which images are matched with each other, and which show nothing new.

All pairs of a small set; neighbours of a sequence; the most alike of a large set, by VLAD (Jégou et
al., "Aggregating local descriptors into a compact image representation", 2010) of the best ranked
keypoints, with a vocabulary of the set itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .._shared.opencv import cv2
from ..batch.pair_list import Pair

COMPARED_KEYPOINTS = 512
"""The best ones of each image, by which images are compared."""

WORDS = 64
"""Of the vocabulary."""

SIMILAR = 20
"""Most similar images that each one is matched with."""

MIN_MATCHED = 0.5
"""Of the keypoints of the image with fewer, matches by which images are said to show the same."""

KMEANS_ITERATIONS = 10
MAX_TRAINING_DESCRIPTORS = 50_000


def similar_pairs(names: Sequence[str], vectors: np.ndarray, count: int) -> list[Pair]:
    """Return each name with the `count` whose vectors (N, D) are most alike, every pair once."""
    found: set[tuple[int, int]] = set()
    for k, vector in enumerate(vectors):
        alike = vectors @ vector
        alike[k] = -np.inf
        best = np.argsort(-alike, kind="stable")[: min(count, len(names) - 1)]
        found |= {(min(k, int(other)), max(k, int(other))) for other in best}
    return [(names[a], names[b]) for a, b in sorted(found)]


def largest_component(pairs: Sequence[Pair]) -> int:
    """Return the number of images in the largest component that pairs connect."""
    components: list[set[str]] = []
    for pair in pairs:
        touched = [names for names in components if not names.isdisjoint(pair)]
        components = [names for names in components if names.isdisjoint(pair)]
        components.append(set(pair).union(*touched))
    return max(map(len, components), default=0)


def motion(first: np.ndarray, second: np.ndarray, matches: np.ndarray) -> float:
    """Return how far most matched keypoints are from their partners, in pixels; infinite in doubt.

    Keypoints are (N, 2) and (M, 2) pixels of two images, matches (K, 2) rows of both. Few of them
    may be of what stands still in the frame, as a bonnet or a time that is shown.
    """
    if len(matches) < MIN_MATCHED * min(len(first), len(second)):
        return np.inf
    return float(np.median(np.linalg.norm(second[matches[:, 1]] - first[matches[:, 0]], axis=1)))


def thin_out(
    names: Sequence[str], near: Mapping[Pair, float], dropped: Mapping[str, str] = {}
) -> dict[str, str]:
    """Leave out images that are near to one before them that is kept, and return that one, too.

    Args:
        names: in their order.
        near: pairs that are too near to each other, with their distance.
        dropped: what was left out before; what it is near to is kept.
    """
    partners: dict[str, dict[str, float]] = {name: {} for name in names}
    for (first, second), distance in near.items():
        partners[first][second] = partners[second][first] = distance
    needed = {*dropped.values()}
    kept: dict[str, None] = {}
    found = {}
    for name in names:
        before = kept.keys() & partners[name]
        if before and name not in needed:
            found[name] = min(before, key=partners[name].__getitem__)
        else:
            kept[name] = None
    return found


def vlad_vectors(descriptors: Sequence[np.ndarray], seed: int = 0) -> np.ndarray:
    """Describe each image by one vector: VLAD with the square roots of what each word sums.

    Descriptors (N_i, D) float32 have length 1; so have vectors (images, WORDS * D), or 0 if empty.
    """
    centres = _vocabulary(np.concatenate(descriptors), seed)
    vectors = np.zeros((len(descriptors), centres.size), np.float32)
    for row, own in enumerate(descriptors):
        if not len(own):
            continue
        nearest = _nearest(own, centres)
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, own - centres[nearest])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        flat = sums.ravel()
        vectors[row] = flat / max(float(np.linalg.norm(flat)), 1e-12)
    return vectors


def _vocabulary(descriptors: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if len(descriptors) > MAX_TRAINING_DESCRIPTORS:
        descriptors = rng.choice(descriptors, MAX_TRAINING_DESCRIPTORS, replace=False)
    centres = rng.choice(descriptors, min(WORDS, len(descriptors)), replace=False)
    nearest = _nearest(descriptors, centres).astype(np.int32)
    criteria = (cv2.TERM_CRITERIA_COUNT, KMEANS_ITERATIONS, 0.0)
    flags = cv2.KMEANS_USE_INITIAL_LABELS
    return cv2.kmeans(descriptors, len(centres), nearest, criteria, 1, flags)[2]


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    squares = (centres**2).sum(axis=1)
    return np.asarray(np.argmin(squares - 2 * descriptors @ centres.T, axis=1))
