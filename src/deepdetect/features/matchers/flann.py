"""FLANN: approximate search in randomised kd-trees, as the paper's code does it."""

from __future__ import annotations

import cv2
import numpy as np

KD_TREE = 1
TREES = 5
CHECKS = 50


def flann_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: object = None,
    trees: int = TREES,
    checks: int = CHECKS,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbours in kd-trees.

    Args:
        queries: (N, D) descriptors, uint8 or float32.
        base: (M, D) descriptors, M >= count.
        count: neighbours of each query.
        seed: of the random trees; the result is the same for the same seed.
        positions: not used; all matchers take the same arguments.
        trees: number of trees.
        checks: leaves that a query looks at.

    Returns:
        (N, count) int32 rows of `base` and (N, count) float32 Euclidean distances,
        the nearest first. The search is approximate: it misses some neighbours.
    """
    queries, base = (np.asarray(part, np.float32) for part in (queries, base))
    cv2.setRNGSeed(seed)
    index = cv2.flann_Index(base, {"algorithm": KD_TREE, "trees": trees})
    rows, squared = index.knnSearch(queries, count, params={"checks": checks})
    return rows, np.sqrt(squared)
