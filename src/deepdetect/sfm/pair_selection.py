"""Which photographs are matched with each other.

All pairs of a small set; neighbours of a sequence; the most alike of a large set, by VLAD (Jégou et
al., "Aggregating local descriptors into a compact image representation", 2010) of the best ranked
keypoints, with a vocabulary of the set itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .._shared.options import check_ranges, suggest_keywords

Pair = tuple[str, str]

KMEANS_ITERATIONS = 10
MAX_TRAINING_DESCRIPTORS = 50_000


@suggest_keywords
@dataclass(frozen=True)
class PairSelectionOptions:
    """Which photographs are matched with each other.

    Attributes:
        pairs: "all", "sequential" (neighbours in the order of their names), "similar" (the most
            alike), or "auto": all of up to `max_exhaustive`, else the most alike.
        sequential: number of following photographs that each one is matched with.
        similar: number of most similar photographs that each one is matched with.
        max_exhaustive: photographs of which all pairs are matched.
        keypoints: the best ones of each photograph by which they are compared.
        words: of the vocabulary.
        seed: of the vocabulary.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    pairs: Literal["auto", "all", "sequential", "similar"] = "auto"
    sequential: int = 10
    similar: int = 20
    max_exhaustive: int = 50
    keypoints: int = 512
    words: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        from .._shared.errors import unknown_name

        known = ("auto", "all", "sequential", "similar")
        if self.pairs not in known:
            raise unknown_name("way to choose pairs", self.pairs, known)
        check_ranges(
            self,
            positive=("sequential", "similar", "keypoints", "words"),
            not_negative=("max_exhaustive", "seed"),
        )

    def way(self, count: int) -> str:
        """Return how the pairs of so many photographs are chosen."""
        if self.pairs != "auto":
            return self.pairs
        return "all" if count <= self.max_exhaustive else "similar"


def all_pairs(names: Sequence[str]) -> list[Pair]:
    """Return every pair once.

    Example:
        >>> all_pairs(["a", "b", "c"])
        [('a', 'b'), ('a', 'c'), ('b', 'c')]
    """
    return list(itertools.combinations(names, 2))


def sequential_pairs(names: Sequence[str], following: int) -> list[Pair]:
    """Return each name with so many that follow it.

    Example:
        >>> sequential_pairs(["a", "b", "c", "d"], 2)
        [('a', 'b'), ('a', 'c'), ('b', 'c'), ('b', 'd'), ('c', 'd')]
    """
    return [
        (name, other)
        for k, name in enumerate(names)
        for other in names[k + 1 : k + 1 + int(following)]
    ]


def similar_pairs(names: Sequence[str], vectors: np.ndarray, count: int) -> list[Pair]:
    """Return each name with those whose vectors are most alike, every pair once.

    Args:
        names: of the photographs.
        vectors: (N, D) of length 1, one each.
        count: partners of each; it may also be a partner of others.

    Example:
        >>> angles = np.radians([0, 10, 90, 95])
        >>> similar_pairs("abcd", np.column_stack([np.cos(angles), np.sin(angles)]), 1)
        [('a', 'b'), ('c', 'd')]
    """
    found: set[tuple[int, int]] = set()
    for k, vector in enumerate(vectors):
        alike = vectors @ vector
        alike[k] = -np.inf
        best = np.argsort(-alike, kind="stable")[: min(int(count), len(names) - 1)]
        found |= {(min(k, int(other)), max(k, int(other))) for other in best}
    return [(names[a], names[b]) for a, b in sorted(found)]


def largest_group(pairs: Sequence[Pair]) -> int:
    """Return the number of photographs in the largest group that pairs connect.

    Example:
        >>> largest_group([("a", "b"), ("c", "d"), ("b", "e")]), largest_group([])
        (3, 0)
    """
    neighbours: dict[str, set[str]] = {}
    for first, second in pairs:
        neighbours.setdefault(first, set()).add(second)
        neighbours.setdefault(second, set()).add(first)
    largest = 0
    while neighbours:
        count, edge = 0, {next(iter(neighbours))}
        while edge:
            count += len(edge)
            edge = set[str]().union(*(neighbours.pop(name) for name in edge)) & neighbours.keys()
        largest = max(largest, count)
    return largest


def vlad_vectors(
    descriptors: Sequence[np.ndarray], options: PairSelectionOptions = PairSelectionOptions()
) -> np.ndarray:
    """Describe each photograph by one vector: VLAD with the square roots of what each word sums.

    Args:
        descriptors: (N_i, D) float32 of each photograph, of length 1; best keypoints first.
        options: of the vocabulary.

    Returns:
        (images, words * D) float32 of length 1; 0 for a photograph without keypoints.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> one, two = rng.random((2, 40, 8), np.float32)
        >>> found = vlad_vectors([one, two, one[:30]], PairSelectionOptions(words=4))
        >>> bool(found[0] @ found[2] > found[0] @ found[1])
        True
    """
    best = [np.asarray(each[: options.keypoints], np.float32) for each in descriptors]
    centres = _vocabulary(np.concatenate(best), options)
    vectors = np.zeros((len(best), centres.size), np.float32)
    for row, own in enumerate(best):
        if not len(own):
            continue
        words = _nearest(own, centres)
        sums = np.zeros_like(centres)
        np.add.at(sums, words, own - centres[words])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
        flat = sums.ravel()
        vectors[row] = flat / max(float(np.linalg.norm(flat)), 1e-12)
    return vectors


def _vocabulary(descriptors: np.ndarray, options: PairSelectionOptions) -> np.ndarray:
    """Return the centres of k-means."""
    rng = np.random.default_rng(options.seed)
    if len(descriptors) > MAX_TRAINING_DESCRIPTORS:
        descriptors = descriptors[
            rng.choice(len(descriptors), MAX_TRAINING_DESCRIPTORS, replace=False)
        ]
    count = min(options.words, len(descriptors))
    centres = descriptors[rng.choice(len(descriptors), count, replace=False)].copy()
    for _ in range(KMEANS_ITERATIONS):
        words = _nearest(descriptors, centres)
        sizes = np.bincount(words, minlength=count)
        sums = np.zeros_like(centres)
        np.add.at(sums, words, descriptors)
        filled = sizes > 0
        centres[filled] = sums[filled] / sizes[filled, None]
    return centres


def _nearest(descriptors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the row of the nearest centre of each descriptor."""
    squares = (centres**2).sum(axis=1)
    return np.asarray(np.argmin(squares - 2 * descriptors @ centres.T, axis=1))
