"""Which points of a cloud are kept: enough parallax, and statistical outlier removal (SOR).

Rusu et al., "Towards 3D point cloud based object maps for household environments", 2008, as in PCL
and Open3D; but in `disparity_space`, where the spacing of the points of a stereo pair is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords

FLANN_INDEX_KDTREE_SINGLE = 4
"""FLANN's number of the kd-tree that is exact in few dimensions."""

SOR_DISPARITY_WEIGHT = 2.0
"""Distance of 1 px of disparity in `disparity_space`, in pixels of the image."""

QUERIES = 200_000
"""Points whose neighbours are looked up at a time, to bound the memory."""


@suggest_keywords
@dataclass(frozen=True)
class PointFilterOptions:
    """Which triangulated points are kept.

    Attributes:
        min_parallax_px: the rays of a point must differ by the angle of this many pixels: less
            says nothing about the depth. For rectified pairs, the least disparity (with offset).
        sor_neighbors: nearest points that SOR compares with, in `disparity_space`; 0: no SOR, for
            rectified pairs neither.
        sor_std_ratio: standard deviations above the mean distance; fewer remove more.

    Raises:
        OptionError: a value is out of its range.
    """

    min_parallax_px: float = 2.0
    sor_neighbors: int = 16
    sor_std_ratio: float = 2.0

    def __post_init__(self) -> None:
        check_ranges(self, not_negative=("min_parallax_px", "sor_neighbors", "sor_std_ratio"))


def sor_inliers(
    points: np.ndarray, point_filter: PointFilterOptions = PointFilterOptions()
) -> np.ndarray:
    """Return which points (N, 3) have others around them."""
    if len(points) < 2:
        return np.ones(len(points), bool)
    distances = mean_neighbor_distances(points, point_filter.sor_neighbors)
    limit = distances.mean() + point_filter.sor_std_ratio * distances.std()
    return np.asarray(distances <= limit)


def mean_neighbor_distances(points: np.ndarray, neighbors: int) -> np.ndarray:
    """Return the mean distance of each of (N, 3) finite points to its nearest others, (N,) float64.

    By OpenCV's FLANN: its single kd-tree is exact, and faster than SciPy's on 850,000 points.
    """
    points = np.asarray(points, np.float64)
    centred = np.ascontiguousarray(points - points.mean(0), np.float32)
    count = min(neighbors + 1, len(points))
    tree = cv2.flann_Index(centred, {"algorithm": FLANN_INDEX_KDTREE_SINGLE, "leaf_max_size": 10})
    means = np.empty(len(centred))
    for start in range(0, len(centred), QUERIES):
        some = centred[start : start + QUERIES]
        _, squares = tree.knnSearch(some, count, params={"checks": -1})
        # The nearest is the point itself, or one in the same place.
        means[start : start + QUERIES] = np.sqrt(squares[:, 1:].astype(np.float64)).mean(1)
    return means


def disparity_space(points: np.ndarray, focal_px: float, baseline: float = 1.0) -> np.ndarray:
    """Return (N, 3) points as (x, y, weight * disparity) in pixels of the first camera."""
    across = points[:, :2] / points[:, 2:] * focal_px
    disparity = focal_px * baseline / points[:, 2]
    return np.column_stack([across, SOR_DISPARITY_WEIGHT * disparity])
