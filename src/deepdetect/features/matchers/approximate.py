"""Approximate search: FLANN's randomised kd-trees, as in the paper's code, and faiss.

faiss keeps an inverted file of quantised descriptors (Johnson, Douze and Jégou, "Billion-scale
similarity search with GPUs", 2017); on bytes its quantiser of eight bits loses nothing.
"""

from __future__ import annotations

import cv2
import numpy as np

from ..._shared.errors import MissingExtraError

KD_TREE = 1
TREES = 5
CHECKS = 50

LISTS_PER_ROOT = 4
"""Lists of the inverted file, in units of the square root of the number of descriptors."""

PROBES = 16
"""Lists that are searched for each query."""

TRAINING = 40
"""Descriptors for each list that the lists' centres are found from."""

FEWEST = 4096
"""Descriptors under which all are compared: an inverted file would save nothing."""


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


def faiss_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find the nearest neighbours in an inverted file.

    Args:
        queries: (N, D) descriptors, uint8 or float32.
        base: (M, D) descriptors, M >= count.
        count: neighbours of each query.
        seed: of the choice of descriptors that the centres are found from.
        positions: not used; all matchers take the same arguments.

    Returns:
        (N, count) int32 rows of `base` and (N, count) float32 Euclidean distances, the nearest
        first. The search is approximate: it misses a neighbour in fifty.

    Raises:
        MissingExtraError: faiss is not installed.
    """
    try:
        import faiss
    except ImportError:
        raise MissingExtraError(
            "the matcher faiss needs faiss: pip install 'deepdetect[faiss]', or take flann"
        ) from None
    quantiser = faiss.ScalarQuantizer
    kind = quantiser.QT_8bit_direct if base.dtype == np.uint8 else quantiser.QT_8bit
    queries, base = (np.ascontiguousarray(part, np.float32) for part in (queries, base))
    width = base.shape[1]
    if len(base) < FEWEST:
        index = faiss.IndexFlatL2(width)
    else:
        lists = int(LISTS_PER_ROOT * np.sqrt(len(base)))
        lists = min(lists, len(base) // TRAINING)
        centres = faiss.IndexFlatL2(width)
        index = faiss.IndexIVFScalarQuantizer(centres, width, lists, kind, faiss.METRIC_L2, False)
        index.cp.seed = seed
        index.cp.niter = 5
        index.nprobe = PROBES
        chosen = np.random.default_rng(seed).permutation(len(base))[: lists * TRAINING]
        index.train(base[np.sort(chosen)])
    index.add(base)
    squared, rows = index.search(queries, count)
    missing = rows < 0  # the lists that were searched held too few
    rows, squared = np.where(missing, 0, rows), np.where(missing, np.inf, squared)
    return rows.astype(np.int32), np.sqrt(np.maximum(squared, 0)).astype(np.float32)
