"""Which images of a collection are most alike, by their features.

By VLAD (Jégou et al., "Aggregating local descriptors into a compact image representation", 2010) of
the best keypoints, with a vocabulary of the collection itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import InvalidFileError
from .._shared.opencv import cv2
from .._shared.progress import progress
from ..features.keypoints import unit_length
from .extraction import read_keypoints
from .hdf5 import open_hdf5
from .pair_list import Pair

COMPARED_KEYPOINTS = 512
"""The best ones of each image, by which images are compared."""

WORDS, DESCRIPTORS_OF_WORD = 64, 8
"""Of the vocabulary; of few descriptors there are fewer, each of so many."""

KMEANS_ITERATIONS = 10
TRAINING_IMAGES, TRAINING_DESCRIPTORS = 500, 50_000
"""At most so many tell the vocabulary."""

COMPARED_ROWS = 256
"""Images that are compared with all others at once: of 100,000 these are 100 MB."""


def similar_pairs(
    features: Path, names: Sequence[str], count: int, seed: int = 0, quiet: bool = True
) -> list[Pair]:
    """Return each image with the `count` that are most like it, every pair once.

    Images without descriptors, or with damaged ones, are in no pair.
    """
    with open_hdf5(features) as file, progress(len(names), "comparing", "image", quiet) as bar:
        vectors = vlad_vectors(
            len(names), lambda k: _best_descriptors(file, names[k]), seed, bar.update
        )
    described = np.flatnonzero(vectors.any(axis=1))
    if len(described) < len(names):
        vectors = vectors[described]
    pairs = {
        (min(k, other), max(k, other))
        for k, alike in enumerate(most_alike(vectors, count))
        for other in alike.tolist()
    }
    return [(names[described[a]], names[described[b]]) for a, b in sorted(pairs)]


def _best_descriptors(file: Any, name: str) -> np.ndarray:
    try:
        keypoints = read_keypoints(file, name)
    except InvalidFileError:  # who matches it is told
        return np.empty((0, 0), np.float32)
    if keypoints.descriptors is None:
        return np.empty((0, 0), np.float32)
    best = np.argsort(-keypoints.scores, kind="stable")[:COMPARED_KEYPOINTS]
    return unit_length(keypoints.descriptors[best])


def vlad_vectors(
    count: int,
    descriptors: Callable[[int], np.ndarray],
    seed: int = 0,
    done: Callable[[], object] = lambda: None,
) -> np.ndarray:
    """Describe each image by one vector: VLAD with the sum of each word at length 1.

    `descriptors` returns those of an image, (N_i, D) float32 of length 1; vectors are (images,
    WORDS * D) of length 1, or 0 if it has none.
    """
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(count)[:TRAINING_IMAGES].tolist()
    found = [own for k in chosen for own in [descriptors(k)] if len(own)]
    if not found:
        return np.zeros((count, 1), np.float32)
    centres = _vocabulary(np.concatenate(found), rng)
    vectors = np.zeros((count, centres.size), np.float32)
    for row in range(count):
        own = descriptors(row)
        if len(own):
            nearest = _nearest(own, centres)
            sums = np.zeros_like(centres)
            np.add.at(sums, nearest, own - centres[nearest])
            sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
            vectors[row] = sums.ravel() / max(float(np.linalg.norm(sums)), 1e-12)
        done()
    return vectors


def most_alike(vectors: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Yield for each of some vectors the rows of the `count` others with the largest products."""
    last = min(count, len(vectors) - 1)
    for start in range(0, len(vectors), COMPARED_ROWS):
        apart = -vectors[start : start + COMPARED_ROWS] @ vectors.T
        own = np.arange(len(apart))
        apart[own, start + own] = np.inf
        yield from np.argpartition(apart, last, axis=1)[:, :last]


def _vocabulary(descriptors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    descriptors = rng.permutation(descriptors)[:TRAINING_DESCRIPTORS]
    centres = descriptors[: min(WORDS, max(1, len(descriptors) // DESCRIPTORS_OF_WORD))]
    nearest = _nearest(descriptors, centres).astype(np.int32)
    criteria = (cv2.TERM_CRITERIA_COUNT, KMEANS_ITERATIONS, 0.0)
    flags = cv2.KMEANS_USE_INITIAL_LABELS
    return cv2.kmeans(descriptors, len(centres), nearest, criteria, 1, flags)[2]


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    squares = (centres**2).sum(axis=1)
    return np.asarray(np.argmin(squares - 2 * descriptors @ centres.T, axis=1))
