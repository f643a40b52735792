"""Measure the repeatability of keypoints, and their fraction on the foreground.

There are two definitions of repeatability. In the paper's, several keypoints may share a partner
in the other image, so a detector that marks every pixel scores best. With mutual nearest
neighbours, a keypoint has at most one partner, and only keypoints in the overlap count.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from deepdetect.geometry.transforms import transform_points
from deepdetect.io.image import at_pixels

from .homography import Sizes, project_visible

CHANCE_POINTS = 20_000
"""Random points are drawn repeatedly until their total number reaches this, because the chance
level of few points would be noisy. Chosen by hand."""

MAX_DRAWS = 100
"""Random points are drawn at most this often, even if keypoints are few. Chosen by hand."""

MIN_POINTS_FOR_THREADS = 20_000


def repeatability_paper(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, radius_px: float = 1.0
) -> float:
    """Return the repeatability as the paper's code computes it, clipped at 1.

    It is the number of points of the first image that the homography maps to less than the radius
    from any point of the second, divided by the number of points in the image with fewer points.
    Points outside the overlap also count, and several points may share a partner.
    """
    fewest = min(len(points0), len(points1))
    if not fewest:
        return 0.0
    mapped = transform_points(points0, homography)
    mapped = mapped[np.isfinite(mapped).all(axis=1)]
    distance, _ = _nearest(_kd_tree(points1), mapped, radius_px)
    return min(np.count_nonzero(distance < radius_px) / fewest, 1.0)


def mutual_nn_repeatability(
    points0: np.ndarray,
    points1: np.ndarray,
    homography: np.ndarray,
    sizes: Sizes,
    radii_px: Sequence[float] = (1.0, 2.0, 3.0),
    with_chance: bool = True,
) -> list[tuple[float, float, float]]:
    """Measure the repeatability by mutual nearest neighbours in the overlap of two images.

    Returns (repeatability, chance level, distance) for each radius. Repeatability: number of pairs
    of mutual nearest neighbours within the radius, divided by the smaller number of keypoints in
    the overlap. Chance level: repeatability of as many random points, or NaN if not requested.
    Distance: mean distance of the pairs in pixels, or NaN without pairs.
    """
    visible = _in_overlap(points0, points1, homography, sizes)
    distances = _mutual_distances(*visible, max(radii_px))
    counts = (len(visible[0]), len(visible[1]))
    chances = [float("nan")] * len(radii_px)
    if with_chance:
        on_pixels = all(bool((np.rint(points) == points).all()) for points in (points0, points1))
        chances = _chance(counts, homography, sizes, radii_px, on_pixels)
    results = []
    for radius, chance in zip(radii_px, chances, strict=True):
        near = distances[distances <= radius]
        value = len(near) / min(counts) if min(counts) else 0.0
        results.append((value, chance, float(near.mean()) if len(near) else float("nan")))
    return results


def _in_overlap(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, sizes: Sizes
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of each image that the other shows, in coordinates of the second image."""
    mapped = project_visible(points0, homography, sizes[1])
    back = project_visible(points1, np.linalg.inv(homography), sizes[0])
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    return mapped[np.isfinite(mapped[:, 0])], points1[np.isfinite(back[:, 0])]


def _kd_tree(points: np.ndarray) -> Any:
    return KDTree(np.asarray(points, np.float64).reshape(-1, 2))


def _nearest(tree: Any, points: np.ndarray, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each point to the nearest point in the tree, and that point's index.

    If no point is within the radius, the distance is inf.
    """
    # An upper bound saves time. KDTree excludes the bound, so the bound must exceed the radius.
    bound = np.nextafter(radius_px, np.inf)
    workers = -1 if min(tree.n, len(points)) > MIN_POINTS_FOR_THREADS else 1
    distance, rows = tree.query(points, distance_upper_bound=bound, workers=workers)
    return distance, rows


def _mutual_distances(points0: np.ndarray, points1: np.ndarray, radius_px: float) -> np.ndarray:
    """Return the distances between mutual nearest neighbours within the radius, in pixels."""
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
    on_pixels: bool,
) -> list[float]:
    """Return the repeatability of `counts` random points in the overlap, for each radius.

    If `on_pixels`, the points are at pixel centres. If nothing moves between the images, these have
    a higher chance level than other positions: a circle with a radius of 1 px around a pixel centre
    has an area of 3.14 pixels, but contains five pixel centres.
    """
    fewest = min(counts)
    if not fewest:
        return [0.0] * len(radii_px)
    grids = _overlapping_grids(np.asarray(homography, np.float64).tobytes(), sizes)
    generator = np.random.default_rng(0)
    draws = min(-(-CHANCE_POINTS // fewest), MAX_DRAWS)
    found = np.zeros(len(radii_px))
    for _ in range(draws):
        # Detectors that mark a pixel several times may find more keypoints than there are pixels.
        drawn = [
            grid[generator.choice(len(grid), count, replace=count > len(grid))]
            for grid, count in zip(grids, counts, strict=True)
        ]
        if not on_pixels:
            drawn = [points + generator.uniform(-0.5, 0.5, points.shape) for points in drawn]
        distances = _mutual_distances(drawn[0], drawn[1], max(radii_px))
        found += [(distances <= radius).sum() for radius in radii_px]
    return [float(value) for value in found / (draws * fewest)]


@lru_cache(maxsize=2)  # a pair is measured at several numbers of keypoints with the same grids
def _overlapping_grids(homography: bytes, sizes: Sizes) -> tuple[np.ndarray, np.ndarray]:
    def grid(size: tuple[int, int]) -> np.ndarray:
        row, column = np.indices((size[1], size[0]))
        return np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)

    matrix = np.frombuffer(homography).reshape(3, 3)
    return _in_overlap(grid(sizes[0]), grid(sizes[1]), matrix, sizes)


def foreground_fraction(xy: np.ndarray, foreground: np.ndarray) -> float:
    """Return the fraction of keypoints, (N, 2), on the (H, W) foreground mask; NaN if N is 0."""
    return float(at_pixels(foreground, xy).mean()) if len(xy) else float("nan")
