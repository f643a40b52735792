"""Approximate search: FLANN's randomised kd-trees, as in the paper's code, and faiss.

faiss keeps an inverted file of quantised descriptors (Johnson, Douze and Jégou, "Billion-scale
similarity search with GPUs", 2017); on bytes its quantiser of eight bits loses nothing.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from ..._shared.errors import MissingExtraError
from ..._shared.opencv import cv2

FLANN_INDEX_KDTREE = 1

TREES, CHECKS = 5, 50
"""Of FLANN, as in the paper's code."""

LISTS_PER_ROOT, PROBES, TRAINING_PER_LIST = 4, 16, 40
"""Of faiss: lists of the inverted file, in units of the square root of the descriptors; lists that
are searched for each query; descriptors that the centre of each list is trained on."""

MIN_INDEXED = 4096
"""With fewer descriptors faiss compares all: an inverted file would save nothing."""


def flann_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: object = None,
    trees: int = TREES,
    checks: int = CHECKS,
) -> tuple[np.ndarray, np.ndarray]:
    """Find approximate nearest neighbours in random kd-trees; otherwise as `Matcher`.

    Args:
        trees: number of trees.
        checks: leaves that are visited for each query.
    """
    queries, base = (np.asarray(part, np.float32) for part in (queries, base))

    def search() -> tuple[np.ndarray, np.ndarray]:
        cv2.setRNGSeed(seed)
        index = cv2.flann_Index(base, {"algorithm": FLANN_INDEX_KDTREE, "trees": trees})
        return index.knnSearch(queries, count, params={"checks": checks})

    # OpenCV has one random number generator per thread: that of the caller is left alone.
    with ThreadPoolExecutor(1) as thread:
        rows, squared = thread.submit(search).result()
    return rows, np.sqrt(squared)


def faiss_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: object = None
) -> tuple[np.ndarray, np.ndarray]:
    """Find approximate nearest neighbours in an inverted file; otherwise as `Matcher`.

    About one neighbour in fifty is missed.

    Raises:
        MissingExtraError: faiss is not installed.
    """
    try:
        import faiss
    except ImportError:
        raise MissingExtraError(
            "the matcher faiss needs faiss: run pip install faiss-cpu, or use flann"
        ) from None
    quantizer = faiss.ScalarQuantizer
    kind = quantizer.QT_8bit_direct if base.dtype == np.uint8 else quantizer.QT_8bit
    queries, base = (np.ascontiguousarray(part, np.float32) for part in (queries, base))
    width = base.shape[1]
    centres = faiss.IndexFlatL2(width)
    index: Any = centres
    if len(base) >= MIN_INDEXED:
        lists = min(int(LISTS_PER_ROOT * np.sqrt(len(base))), len(base) // TRAINING_PER_LIST)
        index = faiss.IndexIVFScalarQuantizer(centres, width, lists, kind, faiss.METRIC_L2, False)
        index.cp.seed = seed
        index.cp.niter = 5
        index.nprobe = PROBES
        order = np.random.default_rng(seed).permutation(len(base))
        index.train(base[np.sort(order[: lists * TRAINING_PER_LIST])])
    index.add(base)
    squared, rows = index.search(queries, count)
    missing = rows < 0  # the lists that were searched held too few
    rows, squared = np.where(missing, 0, rows), np.where(missing, np.inf, squared)
    return rows.astype(np.int32), np.sqrt(np.maximum(squared, 0)).astype(np.float32)
