"""Which images are matched with each other.

All pairs of a small set; neighbours of a sequence; the most alike of a large set, by VLAD (Jégou et
al., "Aggregating local descriptors into a compact image representation", 2010) of the best ranked
keypoints, with a vocabulary of the set itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..batch.pair_list import Pair

COMPARED_KEYPOINTS = 512
"""The best ones of each image, by which images are compared."""

WORDS = 64
"""Of the vocabulary."""

SIMILAR = 20
"""Most similar images that each one is matched with."""

KMEANS_ITERATIONS = 10
MAX_TRAINING_DESCRIPTORS = 50_000


def similar_pairs(names: Sequence[str], vectors: np.ndarray, count: int) -> list[Pair]:
    """Return each name with the `count` whose vectors (N, D) are most alike, every pair once.

    Example:
        >>> angles = np.radians([0, 10, 90, 95])
        >>> similar_pairs("abcd", np.column_stack([np.cos(angles), np.sin(angles)]), 1)
        [('a', 'b'), ('c', 'd')]
    """
    found: set[tuple[int, int]] = set()
    for k, vector in enumerate(vectors):
        alike = vectors @ vector
        alike[k] = -np.inf
        best = np.argsort(-alike, kind="stable")[: min(count, len(names) - 1)]
        found |= {(min(k, int(other)), max(k, int(other))) for other in best}
    return [(names[a], names[b]) for a, b in sorted(found)]


def largest_component(pairs: Sequence[Pair]) -> int:
    """Return the number of images in the largest component that pairs connect.

    Example:
        >>> largest_component([("a", "b"), ("c", "d"), ("b", "e")]), largest_component([])
        (3, 0)
    """
    components: list[set[str]] = []
    for pair in pairs:
        touched = [names for names in components if not names.isdisjoint(pair)]
        components = [names for names in components if names.isdisjoint(pair)]
        components.append(set(pair).union(*touched))
    return max(map(len, components), default=0)


def vlad_vectors(
    descriptors: Sequence[np.ndarray], words: int = WORDS, seed: int = 0
) -> np.ndarray:
    """Describe each image by one vector: VLAD with the square roots of what each word sums.

    Descriptors are (N_i, D) float32 of length 1; so are the vectors (images, words * D), or 0 for
    an image without keypoints.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> one, two = rng.random((2, 40, 8), np.float32)
        >>> found = vlad_vectors([one, two, one[:30]], words=4)
        >>> bool(found[0] @ found[2] > found[0] @ found[1])
        True
    """
    centres = _vocabulary(np.concatenate(descriptors), words, seed)
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


def _vocabulary(descriptors: np.ndarray, words: int, seed: int) -> np.ndarray:
    """Return the centres of k-means."""
    rng = np.random.default_rng(seed)
    if len(descriptors) > MAX_TRAINING_DESCRIPTORS:
        descriptors = rng.choice(descriptors, MAX_TRAINING_DESCRIPTORS, replace=False)
    count = min(words, len(descriptors))
    centres = rng.choice(descriptors, count, replace=False)
    for _ in range(KMEANS_ITERATIONS):
        nearest = _nearest(descriptors, centres)
        sizes = np.bincount(nearest, minlength=count)
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, descriptors)
        filled = sizes > 0
        centres[filled] = sums[filled] / sizes[filled, None]
    return centres


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the row of the nearest centre of each descriptor."""
    squares = (centres**2).sum(axis=1)
    return np.asarray(np.argmin(squares - 2 * descriptors @ centres.T, axis=1))
