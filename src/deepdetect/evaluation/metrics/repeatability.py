"""Which keypoints of one image are found again in another.

The paper's definition lets several keypoints share a partner and counts over all keypoints, so a
full grid of pixels scores best. By mutual nearest neighbours a keypoint has one partner at most,
only what both images show counts, and random points of the same number say what the value is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ..._shared.errors import MissingExtraError
from ...geometry.transforms import transform_points
from .homography import Sizes, project_visible

CHANCE_POINTS = 20_000
"""Random points that the chance level is computed from, drawn several times where they are few."""

MAX_DRAWS = 100
MIN_POINTS_FOR_THREADS = 20_000


def repeatability_paper(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, radius_px: float = 1.0
) -> float:
    """Return the repeatability as the paper's code computes it, clipped at 1.

    The number of points of the first image that land strictly closer than `radius_px` to
    some point of the second, over the smaller of the two total counts: points outside the
    overlap count in the denominator, several points may share one, and nothing is
    corrected for chance, which is high at this density.

    Args:
        points0, points1: (N, 2), (M, 2) positions.
        homography: (3, 3) from the first image to the second.
        radius_px: pixels of the second image.

    Returns:
        In [0, 1]; 0 where an image has no points.
    """
    fewest = min(len(points0), len(points1))
    if not fewest:
        return 0.0
    return min(np.count_nonzero(repeated(points0, points1, homography, radius_px)) / fewest, 1.0)


def repeated(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, radius_px: float = 1.0
) -> np.ndarray:
    """Return which points of the first image land near some point of the second.

    Args:
        points0: (N, 2) positions in the first image.
        points1: (M, 2) positions in the second image.
        homography: (3, 3) from the first image to the second.
        radius_px: near is strictly closer.

    Returns:
        (N,) bool.

    Example:
        >>> repeated([[0, 0], [5, 5]], [[0.5, 0]], np.eye(3)).tolist()
        [True, False]
    """
    mapped = transform_points(points0, homography)
    near = np.zeros(len(mapped), bool)
    finite = np.isfinite(mapped).all(1)
    distance, _ = _nearest(_kd_tree(points1), mapped[finite], radius_px)
    near[finite] = distance < radius_px
    return near


@dataclass(frozen=True)
class Repeatability:
    """How many keypoints of two images are at the same places.

    Attributes:
        radius_px: partners are at most this far apart in the second image.
        repeated: pairs of keypoints that are mutual nearest neighbours, and near enough.
        fewest: keypoints in the overlap, of the image that has fewer there.
        localization_px: mean distance of the pairs; NaN without pairs.
        chance: the value that random points of the same numbers reach: pixels, where the keypoints
            are pixels.
    """

    radius_px: float
    repeated: int
    fewest: int
    localization_px: float
    chance: float

    @property
    def value(self) -> float:
        """Fraction of the keypoints that are repeated, in [0, 1]."""
        return self.repeated / self.fewest if self.fewest else 0.0


def mutual_nn_repeatability(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    sizes: Sizes,
    radii_px: Sequence[float] = (1.0, 2.0, 3.0),
    seed: int = 0,
) -> list[Repeatability]:
    """Measure the repeatability by mutual nearest neighbours in the overlap, beside chance.

    Args:
        points0, points1: (N, 2), (M, 2) positions, centre of the first pixel (0, 0).
        homography: (3, 3) from the first image to the second.
        sizes: (width, height) of both images.
        radii_px: in pixels.
        seed: of the random points.

    Returns:
        One for each radius.

    Example:
        >>> corners = np.array([[2.0, 2], [8, 3], [5, 9]])
        >>> moved = corners + [[0, 0], [1.5, 0], [0, 0]]
        >>> found = mutual_nn_repeatability(corners, moved, np.eye(3), ((16, 16), (16, 16)))
        >>> [round(entry.value, 3) for entry in found]
        [0.667, 1.0, 1.0]
    """
    visible0, visible1 = _in_overlap(points0, points1, homography, sizes)
    fewest = min(len(visible0), len(visible1))
    distances = _mutual_distances(visible0, visible1, max(radii_px))
    on_pixels = all(bool((np.rint(points) == points).all()) for points in (points0, points1))
    counts = (len(visible0), len(visible1))
    chances = _chance(counts, homography, sizes, radii_px, seed, on_pixels)
    results = []
    for radius, chance in zip(radii_px, chances, strict=True):
        near = distances[distances <= radius]
        mean = float(near.mean()) if len(near) else float("nan")
        results.append(Repeatability(float(radius), len(near), fewest, mean, chance))
    return results


def repeated_fractions(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    sizes: Sizes,
    radii_px: Sequence[float] = (1.0, 3.0),
) -> list[float]:
    """Return the values of `mutual_nn_repeatability` alone, without chance; its arguments.

    Example:
        >>> corners = np.array([[2.0, 2], [8, 3]])
        >>> repeated_fractions(corners, corners + [[0, 0], [2, 0]], np.eye(3), ((16, 16), (16, 16)))
        [0.5, 1.0]
    """
    visible = _in_overlap(points0, points1, homography, sizes)
    fewest = min(map(len, visible))
    distances = _mutual_distances(*visible, max(radii_px))
    return [float((distances <= r).sum() / fewest) if fewest else 0.0 for r in radii_px]


def _in_overlap(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, sizes: Sizes
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of both images that the other one shows, in the second image."""
    mapped = project_visible(points0, homography, sizes[1])
    back = project_visible(points1, np.linalg.inv(homography), sizes[0])
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    return mapped[np.isfinite(mapped[:, 0])], points1[np.isfinite(back[:, 0])]


def _kd_tree(points: np.ndarray) -> Any:
    try:
        from scipy.spatial import KDTree
    except ImportError:
        raise MissingExtraError(
            "repeatability needs the package scipy, which is not installed: run pip install scipy"
        ) from None
    return KDTree(np.asarray(points, np.float64).reshape(-1, 2))


def _nearest(tree: Any, points: np.ndarray, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distances, infinite beyond the radius, and rows of the nearest points of the tree."""
    # The bound is exclusive in the tree, and keeps it from searching far.
    bound = np.nextafter(radius_px, np.inf)
    workers = -1 if min(tree.n, len(points)) > MIN_POINTS_FOR_THREADS else 1
    distance, rows = tree.query(points, distance_upper_bound=bound, workers=workers)
    return distance, rows


def _mutual_distances(points0: np.ndarray, points1: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the distances of the pairs of points that are mutual nearest neighbours."""
    if not len(points0) or not len(points1):
        return np.empty(0)
    distance, nearest = _nearest(_kd_tree(points1), points0, radius_px)
    _, back = _nearest(_kd_tree(points0), points1, radius_px)
    rows = np.flatnonzero(np.isfinite(distance))
    return distance[rows[back[nearest[rows]] == rows]]


def _chance(
    counts: tuple[int, int],
    homography: np.ndarray,
    sizes: Sizes,
    radii_px: Sequence[float],
    seed: int,
    on_pixels: bool,
) -> list[float]:
    """Return the values of random points of the same number in the overlap of each image.

    Pixels meet more often than points between them where little moves: five lie within 1 px of
    one, on an area of 3.14. So points that are not on pixels are compared with such ones.
    """
    fewest = min(counts)
    if not fewest:
        return [0.0] * len(radii_px)
    grids = _overlapping_grids(np.asarray(homography, np.float64).tobytes(), sizes)
    generator = np.random.default_rng(seed)
    draws = min(-(-CHANCE_POINTS // fewest), MAX_DRAWS)
    found = np.zeros(len(radii_px))
    for _ in range(draws):
        # Classical detectors may mark a pixel more than once; random points then do so too.
        drawn = [
            grid[generator.choice(len(grid), count, replace=count > len(grid))]
            for grid, count in zip(grids, counts, strict=True)
        ]
        if not on_pixels:
            drawn = [points + generator.uniform(-0.5, 0.5, points.shape) for points in drawn]
        distances = _mutual_distances(drawn[0], drawn[1], max(radii_px))
        found += [(distances <= radius).sum() for radius in radii_px]
    return [float(value) for value in found / (draws * fewest)]


@lru_cache(maxsize=2)  # all keypoint budgets of a pair draw from the same
def _overlapping_grids(homography: bytes, sizes: Sizes) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of both images that the other one shows, in the second image."""

    def grid(size: tuple[int, int]) -> np.ndarray:
        row, column = np.indices((size[1], size[0]))
        return np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)

    matrix = np.frombuffer(homography).reshape(3, 3)
    return _in_overlap(grid(sizes[0]), grid(sizes[1]), matrix, sizes)
