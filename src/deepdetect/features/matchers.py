"""Matching of descriptors: nearest neighbours by several matchers, and the ratio test.

To add a matcher, write a function of the signature of `Matcher` and add it to `MATCHERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._shared.errors import OptionError, require_packages
from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .._shared.options import look_up
from .keypoints import on_pixels

BLOCK_SIZE = 4_000_000
"""Numbers of four bytes that exact search holds at a time: 16 MB, most of which caches hold."""

MAX_EXACT_BYTES = 2**24 // (2 * 255**2)
"""Length of descriptors of bytes up to which single precision computes distances exactly."""

MAX_EXACT_PRODUCT = 4e8
"""Keypoints of both images, multiplied, up to which all distances are computed in a moment."""

FLANN_INDEX_KDTREE, TREES, CHECKS = 1, 5, 50
"""Of FLANN, as in the paper's code."""

LISTS_PER_ROOT, PROBES, TRAINING_PER_LIST = 4, 16, 40
"""Of faiss: lists of the inverted file, in units of the square root of the descriptors; lists that
are searched for each query; descriptors that the centre of each list is trained on."""

MIN_INDEXED = 4096
"""With fewer descriptors faiss compares all: an inverted file would save nothing."""

SWEEPS = 4
"""Of PatchMatch over all queries, down and up in turn."""

OFFSETS_PX = (1, 4, 12)
"""Distances to the queries whose neighbours are tried; one pixel where keypoints are dense."""

BAND_HEIGHT_PX = 96
"""Of a part that one thread works on; the result depends on it."""

SEARCH_SHRINK = 3
"""Random tries begin in the whole image around the best neighbour; each next is so much nearer."""

Neighbours = tuple[np.ndarray, np.ndarray]
"""(N, count) int32 rows and (N, count) float32 distances, nearest first."""

Positions = tuple[np.ndarray, np.ndarray] | None
"""Keypoints of both images in pixels; None where they are not all of one scale and angle, so that
neighbours need not match alike."""


Matcher = Callable[[np.ndarray, np.ndarray, int, int, Positions], Neighbours]
"""Finds for (N, D) queries the `count` nearest rows of an (M, D) base, M >= count, both uint8 or
float32: `matcher(queries, base, count, seed, positions)`. The same seed gives the same result."""


def exact_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
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
        nearest = np.empty((len(block), count), np.intp)
        for rank in range(count):  # argmin takes the lower row of equals
            nearest[:, rank] = partial.argmin(1)
            partial[np.arange(len(block)), nearest[:, rank]] = np.inf
        nearest.sort(axis=1)
        # From the differences themselves, so that distances are exact near 0.
        gaps = np.linalg.norm(block[:, None] - base[nearest], axis=2)
        order = np.argsort(gaps, axis=1, kind="stable")
        rows[start : start + step] = np.take_along_axis(nearest, order, 1)
        distances[start : start + step] = np.take_along_axis(gaps, order, 1)
    return rows, distances


def hamming_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find nearest neighbours of binary descriptors (ORB, BRISK) by Hamming, as a `Matcher`."""
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError("the matcher hamming compares binary descriptors: use exact or flann")
    if not len(queries):
        return np.empty((0, count), np.int32), np.empty((0, count), np.float32)
    distances, rows = cv2.batchDistance(
        queries, base, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=count
    )
    return rows, distances.astype(np.float32)


def flann_neighbours(
    queries: np.ndarray,
    base: np.ndarray,
    count: int,
    seed: int,
    positions: Positions = None,
    trees: int = TREES,
    checks: int = CHECKS,
) -> Neighbours:
    """Find approximate nearest neighbours in random kd-trees; otherwise as `Matcher`.

    `checks` leaves are visited for each query.
    """
    queries, base = (np.asarray(part, np.float32) for part in (queries, base))

    def search() -> Neighbours:
        cv2.setRNGSeed(seed)
        index = cv2.flann_Index(base, {"algorithm": FLANN_INDEX_KDTREE, "trees": trees})
        return index.knnSearch(queries, count, params={"checks": checks})

    # OpenCV has one random number generator per thread: that of the caller is left alone.
    with ThreadPoolExecutor(1) as thread:
        rows, squared = thread.submit(search).result()
    return rows, np.sqrt(squared)


def faiss_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find approximate nearest neighbours in an inverted file; otherwise as `Matcher`.

    The file holds quantised descriptors (Johnson, Douze and Jégou, "Billion-scale similarity search
    with GPUs", 2017); bytes lose nothing. About one neighbour in fifty is missed.
    """
    require_packages("the matcher faiss", "faiss")
    import faiss

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


def patchmatch_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find one or two approximate nearest neighbours of each query by spreading good ones.

    A neighbour's match, moved along, is probably a good one (Barnes et al., "PatchMatch", 2009). On
    hundreds of thousands of dense keypoints it takes a twentieth of FLANN's time and finds more
    correct matches; it does not suit few or scattered ones. A `Matcher` of bytes on whole pixels;
    the result is the same for any number of threads.
    """
    if positions is None or not all(on_pixels(xy) for xy in positions):
        raise OptionError(
            "patchmatch needs dense keypoints of one scale and angle, on whole pixels: use auto"
        )
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher patchmatch needs descriptors of bytes: use flann, faiss or exact"
        )
    from . import kernels

    xy0, xy1 = (np.asarray(xy).astype(np.int32) for xy in positions)
    # In row-major order, as of most detectors: a sweep builds on the queries before.
    order = np.lexsort((xy0[:, 0], xy0[:, 1]))
    queries, xy0 = queries[order], xy0[order]
    at0, at1 = _grid(xy0), _grid(xy1)
    edges = np.arange(0, at0.shape[0] + BAND_HEIGHT_PX, BAND_HEIGHT_PX)
    bands = np.searchsorted(xy0[:, 1], edges)
    radii = [max(at1.shape) // 2]
    while radii[-1] > SEARCH_SHRINK:
        radii.append(radii[-1] // SEARCH_SHRINK)
    rows = np.empty((len(queries), 2), np.int32)
    distances = np.empty((len(queries), 2), np.int32)
    parallel_for(len(queries), kernels.patchmatch_start, queries, base, seed, rows, distances)
    images = queries, base, xy0, xy1, at0, at1
    for turn in range(SWEEPS):
        tries = np.array(OFFSETS_PX), turn, seed, np.maximum(radii, 1)
        results = rows.copy(), rows, distances
        parallel_for(len(bands) - 1, kernels.patchmatch_sweep, bands, *images, *tries, *results)
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return rows[back, :count], np.sqrt(distances[back, :count].astype(np.float32))


def _grid(xy: np.ndarray) -> np.ndarray:
    """Return the row at each pixel of the smallest image that holds all, -1 where there is none."""
    width, height = xy.max(axis=0) + 1
    grid = np.full((height, width), -1, np.int32)
    grid[xy[:, 1], xy[:, 0]] = np.arange(len(xy))
    return grid


def automatic_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find neighbours exactly where keypoints are few, else by PatchMatch, else by FLANN.

    PatchMatch needs bytes, and keypoints on whole pixels of one scale and angle.
    """
    if len(queries) * len(base) <= MAX_EXACT_PRODUCT:
        return exact_neighbours(queries, base, count, seed, positions)
    suits = positions is not None and all(on_pixels(xy) for xy in positions)
    if suits and queries.dtype == base.dtype == np.uint8:
        return patchmatch_neighbours(queries, base, count, seed, positions)
    return flann_neighbours(queries, base, count, seed, positions)


MATCHERS: dict[str, Matcher] = {
    "auto": automatic_neighbours,
    "flann": flann_neighbours,
    "exact": exact_neighbours,
    "faiss": faiss_neighbours,
    "patchmatch": patchmatch_neighbours,
    "hamming": hamming_neighbours,
}


def get_matcher(name: str) -> Matcher:
    """Return the matcher of this name; an unknown one is an OptionError."""
    return look_up("matcher", name, MATCHERS)


@dataclass(frozen=True, eq=False)
class DescriptorMatches:
    """Matched rows (M,) of two sets of descriptors.

    `ratios` are Lowe's, (M,) float32: the distance of the best over that of the second-best.
    """

    indices0: np.ndarray
    indices1: np.ndarray
    ratios: np.ndarray

    def __len__(self) -> int:
        return len(self.indices0)


def match_descriptors(
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    matcher: Matcher,
    *,
    ratio: float = 0.99,
    mutual: bool = False,
    seed: int = 0,
    positions: Positions = None,
) -> DescriptorMatches:
    """Match by nearest neighbour and ratio test (Lowe, 2004), by ascending row of the first set.

    The (N, D) and (M, D) descriptors are uint8 or float32; ratios must be below `ratio` (paper's
    code: 0.99); `mutual` keeps only mutual nearest neighbours. `seed` and `positions` are of the
    matcher.
    """
    if len(descriptors0) == 0 or len(descriptors1) < 2:  # there is no second-best neighbour
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    rows, distances = matcher(descriptors0, descriptors1, 2, seed, positions)
    best, second = distances[:, 0], distances[:, 1]
    # Two neighbours at distance 0 are equally good: their ratio is 1.
    ratios = np.divide(best, second, out=np.ones_like(best), where=second > 0)
    ratios[~np.isfinite(second)] = 1  # no second-best was found
    kept = ratios < ratio
    if mutual:
        few = len(descriptors0) * len(descriptors1) <= MAX_EXACT_PRODUCT
        exact = exact_neighbours, hamming_neighbours, *([automatic_neighbours] if few else [])
        if matcher in exact:  # it finds for a query what it finds for many
            asked = np.unique(rows[kept, 0])  # the way back of the others changes nothing
            nearest = np.full(len(descriptors1), -1)
            nearest[asked] = matcher(descriptors1[asked], descriptors0, 1, seed, None)[0][:, 0]
        else:
            back = None if positions is None else positions[::-1]
            nearest = matcher(descriptors1, descriptors0, 1, seed, back)[0][:, 0]
        kept &= nearest[rows[:, 0]] == np.arange(len(rows))
    rows0 = np.flatnonzero(kept).astype(np.int32)
    return DescriptorMatches(rows0, rows[rows0, 0].astype(np.int32), ratios[rows0])
