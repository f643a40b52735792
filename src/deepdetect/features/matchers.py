"""Matching of descriptors: nearest neighbours by several matchers, and the ratio test.

To add a matcher, write a function with the signature of `Matcher` and add it to `MATCHERS`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import OptionError
from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .._shared.options import look_up
from .._shared.runtimes import start_session
from .keypoints import on_pixels

BLOCK_SIZE = 2_000_000
"""Exact search computes this many float32 distances at a time: 8 MB, which fit in most caches."""

MAX_EXACT_BYTES = 2**24 // (2 * 255**2)
"""Maximum length of uint8 descriptors whose squared distances are exact in single precision."""

PRODUCTS = Path(__file__).with_name("products")
"""Folder of ONNX files that multiply two matrices, made by `tools/product_graphs.py`. NumPy takes
twice as long as ONNX Runtime in single precision, and NumPy's threads stay busy afterwards."""

MAX_EXACT_PRODUCT = 4e8
"""Maximum product of the two keypoint counts for which "auto" searches exactly. Chosen by hand."""

FLANN_INDEX_KDTREE, TREES, CHECKS = 1, 5, 50
"""FLANN's code for kd-trees, the number of trees, and the number of leaves that the search for each
query visits, as in the code of the DeepDetect paper."""

SWEEPS, BAND_HEIGHT_PX = 4, 96
"""PatchMatch passes SWEEPS times over all queries, alternately down and up the first image. Its
threads process bands of BAND_HEIGHT_PX rows of this image. Chosen by hand."""

OFFSETS_PX = (1, 4, 12)
"""PatchMatch tries, for each query, the matches of queries at these distances in x or y, shifted by
the distance. The smallest distance is 1 px, because dense keypoints are 1 px apart."""

SEARCH_SHRINK = 3
"""PatchMatch also tries random positions around the best match. The search radius starts at half
the longer side of the second image, and is divided by this number after each try."""

Neighbours = tuple[np.ndarray, np.ndarray]
"""Nearest neighbours of N descriptors, the queries: row numbers in the searched array, the base,
(N, count) int32, and distances, (N, count) float32, nearest first."""

Positions = tuple[np.ndarray, np.ndarray] | None
"""(N, 2) positions of the query keypoints and (M, 2) of those in the base, in pixels. None if the
keypoints differ in scale or angle: nearby keypoints then need not have nearby matches."""


Matcher = Callable[[np.ndarray, np.ndarray, int, int, Positions], Neighbours]
"""A function `matcher(queries, base, count, seed, positions)`. It finds, for each row of `queries`,
(N, D), the `count` nearest rows of `base`, (M, D), with M >= count. Both arrays are uint8 or both
are float32. The same seed gives the same result."""


def exact_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find the exact nearest neighbours by matrix products; a `Matcher`.

    Among equally near rows of the base, the row of lowest index is taken. The time grows with the
    product of the numbers of queries and rows, so this suits up to tens of thousands of keypoints.
    """
    return _search_both_ways(queries, base, count)[:2]


def _search_both_ways(
    queries: np.ndarray, base: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the result of `exact_neighbours`, and the nearest query of each row of the base."""
    from .kernels import scan_products

    width = base.shape[1]
    whole = queries.dtype == base.dtype == np.uint8 and width <= MAX_EXACT_BYTES
    terms0, terms1 = (np.einsum("ij,ij->i", a, a, dtype=np.float64) for a in (queries, base))
    if whole:
        session, offset = _byte_product()
        factor = np.ascontiguousarray(base.T) - np.uint8(offset)
        factor = factor.view(np.int8) if offset else factor
        terms0 -= 2 * offset * queries.sum(1, dtype=np.float64)
    else:
        queries, base = (np.asarray(part, np.float32) for part in (queries, base))
        session, factor = session_of(PRODUCTS / "float.onnx"), np.ascontiguousarray(base.T)
    found = min(count + 1, len(base))  # one more row, to detect ties within rounding errors
    rows = np.empty((len(queries), found), np.int32)
    squared = np.empty((len(queries), found), np.float32)
    nearest = np.zeros(len(base), np.int32)
    best, second = np.full((2, len(base)), np.inf, np.float32)
    step = max(1, BLOCK_SIZE // max(len(base), 2 * count * width))
    parts = [slice(start, start + step) for start in range(0, len(queries), step)]
    terms = terms0.astype(np.float32), terms1.astype(np.float32)
    for part in parts:
        product = session.run(None, {"a": queries[part], "b": factor})[0]
        block = product, terms[0][part], terms[1], part.start
        scan_products(*block, rows[part], squared[part], nearest, best, second)
    if whole or not len(queries):
        return rows[:, :count], np.sqrt(squared[:, :count]), nearest
    # Rounding errors of squared distances are below `bound` times the squared sum of both lengths.
    # Neighbours whose squared distances differ by less are searched again in double precision.
    lengths = np.sqrt(terms0), np.sqrt(terms1)
    bound = (width / 2 + 8) * float(np.finfo(np.float32).eps)
    doubt = bound * (lengths[0] + lengths[1].max()) ** 2
    unsure = np.flatnonzero(squared[:, -1] - squared[:, count - 1] <= doubt)
    rows = rows[:, :count]
    if found > count:
        rows[unsure] = _nearest_in_double(queries[unsure], base, count)
    unsure = np.flatnonzero(second - best <= bound * (lengths[1] + lengths[0].max()) ** 2)
    nearest[unsure] = _nearest_in_double(base[unsure], queries, 1)[:, 0]
    rows.sort(axis=1)
    distances = np.empty((len(queries), count), np.float32)
    for part in parts:
        # Distances are computed again, from the differences, so that those near 0 are exact.
        gaps = np.linalg.norm(queries[part, None] - base[rows[part]], axis=2)
        order = np.argsort(gaps, axis=1, kind="stable")
        rows[part] = np.take_along_axis(rows[part], order, 1)
        distances[part] = np.take_along_axis(gaps, order, 1)
    return rows, distances, nearest


def _nearest_in_double(queries: np.ndarray, base: np.ndarray, count: int) -> np.ndarray:
    rows = np.empty((len(queries), count), np.int32)
    squares = np.einsum("ij,ij->i", base, base, dtype=np.float64)
    step = max(1, BLOCK_SIZE // (2 * len(base)))
    for start in range(0, len(queries), step):
        block = squares - 2 * (queries[start : start + step].astype(np.float64) @ base.T)
        for rank in range(count):  # `argmin` returns the lowest row of a tie
            rows[start : start + step, rank] = nearest = block.argmin(1)
            block[np.arange(len(block)), nearest] = np.inf
    return rows


@functools.cache
def session_of(path: Path) -> Any:
    """Return the ONNX Runtime session of a bundled ONNX file, which is created once and cached."""
    return start_session(str(path))


@functools.cache
def _byte_product() -> tuple[Any, int]:
    """Return a session that multiplies matrices of bytes, and the offset to subtract from the base.

    The fastest instructions (VNNI) multiply unsigned by signed bytes, so 128 is subtracted from the
    base. Processors without VNNI saturate the sums of such products; for them both matrices stay
    unsigned, and the offset is 0.
    """
    session = session_of(PRODUCTS / "signed.onnx")
    most = np.full((8, 64), 255, np.uint8), np.full((64, 64), 127, np.int8)
    if (session.run(None, dict(zip("ab", most, strict=True)))[0] == 64 * 255 * 127).all():
        return session, 128
    return session_of(PRODUCTS / "unsigned.onnx"), 0


def hamming_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find nearest neighbours of binary descriptors by Hamming distance; a `Matcher`."""
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher 'hamming' is for binary descriptors, in uint8: use 'exact' or 'flann'"
        )
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
    """Find approximate nearest neighbours by FLANN's randomised kd-trees.

    `trees` is the number of trees, `checks` the number of leaves that each query visits. The other
    arguments and the result are those of a `Matcher`.
    """
    queries, base = (np.asarray(part, np.float32) for part in (queries, base))

    def search() -> Neighbours:
        cv2.setRNGSeed(seed)
        index = cv2.flann_Index(base, {"algorithm": FLANN_INDEX_KDTREE, "trees": trees})
        return index.knnSearch(queries, count, params={"checks": checks})

    # OpenCV has one random generator per thread: a new thread leaves the caller's unchanged.
    with ThreadPoolExecutor(1) as thread:
        rows, squared = thread.submit(search).result()
    return rows, np.sqrt(squared)


def patchmatch_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find one or two approximate nearest neighbours of each query by PatchMatch; a `Matcher`.

    The match of a neighbouring query, shifted by the offset between the two queries, is probably a
    good match of the query itself (Barnes et al., "PatchMatch", 2009). On hundreds of thousands of
    dense keypoints, PatchMatch takes a twentieth of FLANN's time and finds more correct matches,
    but it does not suit few or scattered keypoints. Descriptors must be uint8 and keypoints on
    whole pixels. The number of threads does not change the result.
    """
    if positions is None or not all(on_pixels(xy) for xy in positions):
        raise OptionError(
            "'patchmatch' needs dense keypoints of one scale and angle, on whole pixels: use 'auto'"
        )
    if queries.dtype != np.uint8 or base.dtype != np.uint8:
        raise OptionError(
            "the matcher 'patchmatch' needs uint8 descriptors: use 'flann' or 'exact'"
        )
    from . import kernels

    xy0, xy1 = (np.asarray(xy).astype(np.int32) for xy in positions)
    # Queries are sorted in row-major order, because a sweep reuses the previous matches.
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
    """Return an image that holds, at each pixel, the row of `xy` with this position, or -1."""
    width, height = xy.max(axis=0) + 1
    grid = np.full((height, width), -1, np.int32)
    grid[xy[:, 1], xy[:, 0]] = np.arange(len(xy))
    return grid


def automatic_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int, seed: int, positions: Positions = None
) -> Neighbours:
    """Find neighbours exactly if keypoints are few, otherwise by PatchMatch or FLANN.

    PatchMatch needs uint8 descriptors and keypoints on whole pixels, of one scale and angle.
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
    "patchmatch": patchmatch_neighbours,
    "hamming": hamming_neighbours,
}

MATCHERS_OF_NUMBERS = tuple(name for name in MATCHERS if name != "hamming")
"""Names of all matchers except the one for binary descriptors such as ORB's."""


def get_matcher(name: str) -> Matcher:
    """Return the matcher of this name; an unknown name raises an OptionError."""
    return look_up("matcher", name, MATCHERS)


@dataclass(frozen=True, eq=False)
class DescriptorMatches:
    """Matches between two sets of descriptors.

    `indices0` and `indices1` are the matched rows of the two sets, (M,) each. `ratios` are Lowe's,
    (M,) float32: the distance to the nearest descriptor over that to the second-nearest.
    `filter_matches` replaces the ratios by the probabilities that matches are wrong.
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
    """Match (N, D) with (M, D) descriptors by nearest neighbour and ratio test (Lowe, 2004).

    Descriptors are uint8 or float32. Matches are kept if Lowe's ratio is below `ratio`, which is
    0.99 in the DeepDetect paper's code. `mutual` keeps only mutual nearest neighbours. `seed` and
    `positions` go to the matcher. The matches are ordered by their rows in the first set.
    """
    if len(descriptors0) == 0 or len(descriptors1) < 2:  # there is no second-best neighbour
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    few = len(descriptors0) * len(descriptors1) <= MAX_EXACT_PRODUCT
    if matcher is exact_neighbours or (few and matcher is automatic_neighbours):
        rows, distances, nearest = _search_both_ways(descriptors0, descriptors1, 2)
    else:
        rows, distances = matcher(descriptors0, descriptors1, 2, seed, positions)
        back = None if positions is None else positions[::-1]
        nearest = matcher(descriptors1, descriptors0, 1, seed, back)[0][:, 0] if mutual else rows
    return kept_matches(rows, distances, nearest, ratio, mutual)


def kept_matches(
    rows: np.ndarray, distances: np.ndarray, nearest: np.ndarray, ratio: float, mutual: bool
) -> DescriptorMatches:
    """Return the matches that pass the ratio test and, if `mutual`, are nearest both ways.

    `rows` and `distances` are the two nearest `Neighbours` of each descriptor of the first set.
    `nearest` has the row of the first set that is nearest to each descriptor of the second set.
    """
    best, second = distances[:, 0], distances[:, 1]
    # If both neighbours are at distance 0, they are equally good, and the ratio is 1.
    ratios = np.divide(best, second, out=np.ones_like(best), where=second > 0)
    kept = ratios < ratio
    if mutual:
        kept &= nearest[rows[:, 0]] == np.arange(len(rows))
    rows0 = np.flatnonzero(kept).astype(np.int32)
    return DescriptorMatches(rows0, rows[rows0, 0].astype(np.int32), ratios[rows0])
