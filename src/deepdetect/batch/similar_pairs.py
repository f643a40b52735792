"""Search for the most similar images of a collection, by their features.

Each image is described by VLAD (Jégou et al., "Aggregating local descriptors into a compact image
representation", 2010) of its best keypoints. The vocabulary is trained on the collection itself.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from .._shared.errors import noted_failures
from .._shared.opencv import cv2
from .._shared.progress import progress
from ..features.keypoints import unit_length
from .extraction import read_keypoints
from .hdf5 import open_hdf5
from .pair_list import Pair

COMPARED_KEYPOINTS = 512
"""An image is described by at most this number of its best keypoints. Chosen by hand."""

WORDS, DESCRIPTORS_OF_WORD = 64, 8
"""The vocabulary has `WORDS` words, or fewer, so that each has at least `DESCRIPTORS_OF_WORD`
training descriptors on average. Chosen by hand."""

TRAINING_IMAGES, TRAINING_DESCRIPTORS, KMEANS_ITERATIONS = 500, 50_000, 10
"""Limits of training images, descriptors and k-means iterations, to save time. Chosen by hand."""

COMPARED_ROWS = 256
"""Number of images compared at once with all others: 300 MB of memory for 100,000 images."""


def similar_pairs(
    features: Path, names: Sequence[str], count: int, seed: int = 0, quiet: bool = True
) -> tuple[list[Pair], list[str]]:
    """Find the `count` most similar images of each image.

    Returns every pair once, and a sentence on each image whose descriptors are missing, damaged, or
    of another type than those of most images. Images without keypoints are left out silently.
    """
    failures, blank = dict[str, str](), set[str]()
    with open_hdf5(features) as file, progress(len(names), "describing", "image", quiet) as bar:

        def descriptors(row: int) -> np.ndarray:
            name = names[row]
            with noted_failures(name, reasons := list[str]()):
                keypoints = read_keypoints(file, name)
                if not len(keypoints):
                    blank.add(name)
                elif keypoints.descriptors is None:
                    reasons.append(f"{name}: it has no descriptors: extract it again")
                else:
                    best = np.argsort(-keypoints.scores, kind="stable")[:COMPARED_KEYPOINTS]
                    return unit_length(keypoints.descriptors[best])
            if reasons:
                failures[name] = reasons[0]
            return np.empty((0, 0), np.float32)

        vectors, rows = vlad_vectors(len(names), descriptors, seed, bar.update)
    for name in {*names} - blank - {names[row] for row in rows}:
        failures.setdefault(
            name, f"{name}: its descriptors are of another type than most: extract all images again"
        )
    pairs: set[tuple[int, int]] = set()
    with progress(len(rows), "comparing", "image", quiet) as bar:
        for k, alike in enumerate(most_alike(vectors, count)):
            pairs |= {(min(k, other), max(k, other)) for other in alike.tolist()}
            bar.update()
    return [(names[rows[a]], names[rows[b]]) for a, b in sorted(pairs)], sorted(failures.values())


def vlad_vectors(
    count: int,
    descriptors: Callable[[int], np.ndarray],
    seed: int = 0,
    done: Callable[[], object] = lambda: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Describe each image by a VLAD vector, after scaling each word's residual sum to unit length.

    `descriptors(i)` returns the descriptors of image i, (N_i, D) float32 of unit length. Returns
    (M, words * D) vectors of unit length, and the (M,) indices of the images. Images without
    descriptors, or with another D than most images, are left out.
    """
    rng = np.random.default_rng(seed)
    described = (own for k in rng.permutation(count).tolist() if len(own := descriptors(k)))
    found = [*islice(described, TRAINING_IMAGES)]
    if not found:
        return np.empty((0, 0), np.float32), np.empty(0, np.int64)
    numbers = Counter(own.shape[1] for own in found).most_common(1)[0][0]
    alike = [own for own in found if own.shape[1] == numbers]
    sample = rng.permutation(np.concatenate(alike))[:TRAINING_DESCRIPTORS]
    words = sample[: min(WORDS, max(1, len(sample) // DESCRIPTORS_OF_WORD))]
    criteria = (cv2.TERM_CRITERIA_COUNT, KMEANS_ITERATIONS, 0.0)
    nearest, flags = _nearest(sample, words).astype(np.int32), cv2.KMEANS_USE_INITIAL_LABELS
    centres = cv2.kmeans(sample, len(words), nearest, criteria, 1, flags)[2]
    vectors, rows = np.empty((count, centres.size), np.float32), list[int]()
    for row in range(count):
        own = descriptors(row)
        if len(own) and own.shape[1] == numbers:
            sums, nearest = np.zeros_like(centres), _nearest(own, centres)
            np.add.at(sums, nearest, own - centres[nearest])
            sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
            vectors[len(rows)] = sums.ravel() / max(float(np.linalg.norm(sums)), 1e-12)
            rows.append(row)
        done()
    return vectors[: len(rows)], np.array(rows, np.int64)


def most_alike(vectors: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Yield, for each vector, the indices of the `count` others with the largest dot products."""
    last = min(count, len(vectors) - 1)
    for start in range(0, len(vectors), COMPARED_ROWS):
        apart = -vectors[start : start + COMPARED_ROWS] @ vectors.T
        own = np.arange(len(apart))
        apart[own, start + own] = np.inf
        yield from np.argpartition(apart, last, axis=1)[:, :last]


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    squares = (centres**2).sum(axis=1)
    return np.asarray(np.argmin(squares - 2 * descriptors @ centres.T, axis=1))
