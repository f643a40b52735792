"""Repeatability as a reader needs it: one to one, in the overlap, beside its chance level.

The published definition (`repeatability.py`) lets several keypoints share a partner and counts
over all keypoints, so that a full grid of pixels scores best. Here a keypoint has one partner at
most, only what both images show counts, and random points of the same number say what the value
is worth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from .overlap import map_into

CHANCE_POINTS = 20_000
"""Random points that the chance level is taken from; few at a time are drawn often."""

MOST_DRAWS = 100

WORTH_THREADS = 20_000
"""Points from which a search is worth starting threads for."""


@dataclass(frozen=True)
class Repeatability:
    """How many keypoints of two images are the same places.

    Attributes:
        radius: in pixels of the second image; partners are at most so far apart.
        repeated: pairs of keypoints that are each other's nearest, and near enough.
        fewest: keypoints in the overlap, of the image that has fewer there.
        localisation: mean distance of the pairs in pixels; NaN without pairs.
        chance: the value that random points of the same numbers reach: pixels, where the keypoints
            are pixels.
    """

    radius: float
    repeated: int
    fewest: int
    localisation: float
    chance: float

    @property
    def value(self) -> float:
        """Share of the keypoints that are repeated, in [0, 1]."""
        return self.repeated / self.fewest if self.fewest else 0.0

    @property
    def corrected(self) -> float:
        """The value, with chance at 0 and all at 1; below 0 when worse than chance."""
        return (self.value - self.chance) / (1 - self.chance) if self.chance < 1 else 0.0


def one_to_one_repeatability(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    radii: Sequence[float] = (1.0, 2.0, 3.0),
    seed: int = 0,
) -> list[Repeatability]:
    """Measure the repeatability of keypoints.

    Args:
        points0, points1: (N, 2), (M, 2) positions, centre of the first pixel (0, 0).
        homography: (3, 3) from the first image to the second.
        sizes: (width, height) of both images.
        radii: in pixels.
        seed: of the random points.

    Returns:
        One for each radius.

    Example:
        >>> corners = np.array([[2.0, 2], [8, 3], [5, 9]])
        >>> moved = corners + [[0, 0], [1.5, 0], [0, 0]]
        >>> found = one_to_one_repeatability(corners, moved, np.eye(3), ((16, 16), (16, 16)))
        >>> [round(entry.value, 3) for entry in found]
        [0.667, 1.0, 1.0]
    """
    seen0, seen1 = _in_overlap(points0, points1, homography, sizes)
    fewest = min(len(seen0), len(seen1))
    distances = _mutual_distances(seen0, seen1, max(radii))
    on_pixels = all(_on_pixels(points) for points in (points0, points1))
    counts = (len(seen0), len(seen1))
    chances = _chance(counts, homography, sizes, radii, seed, on_pixels)
    results = []
    for radius, chance in zip(radii, chances, strict=True):
        near = distances[distances <= radius]
        mean = float(near.mean()) if len(near) else float("nan")
        results.append(Repeatability(float(radius), len(near), fewest, mean, chance))
    return results


def _in_overlap(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of both images that the other one shows, in the second image."""
    mapped = map_into(points0, homography, sizes[1])
    back = map_into(points1, np.linalg.inv(homography), sizes[0])
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    return mapped[np.isfinite(mapped[:, 0])], points1[np.isfinite(back[:, 0])]


def _mutual_distances(points0: np.ndarray, points1: np.ndarray, radius: float) -> np.ndarray:
    """Return the distances of the pairs of points that are each other's nearest."""
    from scipy.spatial import KDTree

    if not len(points0) or not len(points1):
        return np.empty(0)
    # The bound is exclusive in the tree, and keeps it from searching far.
    bound = np.nextafter(radius, np.inf)
    workers = -1 if min(len(points0), len(points1)) > WORTH_THREADS else 1
    distance, nearest = KDTree(points1).query(points0, distance_upper_bound=bound, workers=workers)
    _, back = KDTree(points0).query(points1, distance_upper_bound=bound, workers=workers)
    rows = np.flatnonzero(np.isfinite(distance))
    return distance[rows[back[nearest[rows]] == rows]]


def _on_pixels(points: np.ndarray) -> bool:
    return bool((np.rint(points) == points).all())


def _chance(
    counts: tuple[int, int],
    homography: np.ndarray,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    radii: Sequence[float],
    seed: int,
    on_pixels: bool,
) -> list[float]:
    """Return the values of random points, as many in the overlap of each image.

    Pixels meet more often than points between them where little moves: five lie within 1 px of
    one, on an area of 3.14. So points that are not on pixels are compared with such ones.
    """
    fewest = min(counts)
    if not fewest:
        return [0.0] * len(radii)
    grids = _overlapping_grids(np.asarray(homography, np.float64).tobytes(), sizes)
    generator = np.random.default_rng(seed)
    draws = min(-(-CHANCE_POINTS // fewest), MOST_DRAWS)
    repeated = np.zeros(len(radii))
    for _ in range(draws):
        # Classical detectors may mark a pixel more than once; random points then do so too.
        drawn = [
            grid[generator.choice(len(grid), count, replace=count > len(grid))]
            for grid, count in zip(grids, counts, strict=True)
        ]
        if not on_pixels:
            drawn = [points + generator.uniform(-0.5, 0.5, points.shape) for points in drawn]
        distances = _mutual_distances(drawn[0], drawn[1], max(radii))
        repeated += [(distances <= radius).sum() for radius in radii]
    return [float(value) for value in repeated / (draws * fewest)]


@lru_cache(maxsize=2)  # all budgets and methods of a pair draw from the same
def _overlapping_grids(
    homography: bytes, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of both images that the other one shows, in the second image."""
    matrix = np.frombuffer(homography).reshape(3, 3)
    return _in_overlap(_grid(sizes[0]), _grid(sizes[1]), matrix, sizes)


def _grid(size: tuple[int, int]) -> np.ndarray:
    """Return the centres of all pixels."""
    row, column = np.indices((size[1], size[0]))
    return np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)
