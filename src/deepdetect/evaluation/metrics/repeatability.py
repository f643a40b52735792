"""Which keypoints of one image are found again in another."""

from __future__ import annotations

import numpy as np

from ...geometry.residuals import transform_points


def repeated(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, radius: float = 1.0
) -> np.ndarray:
    """Tell which points of the first image land near some point of the second.

    Args:
        points0: (N, 2) positions in the first image.
        points1: (M, 2) positions in the second image.
        homography: (3, 3) from the first image to the second.
        radius: in pixels; near is strictly closer.

    Returns:
        (N,) bool.

    Example:
        >>> repeated([[0, 0], [5, 5]], [[0.5, 0]], np.eye(3)).tolist()
        [True, False]
    """
    mapped = transform_points(points0, homography)
    base = np.asarray(points1, np.float64).reshape(-1, 2)
    found = np.zeros(len(mapped), bool)
    if not len(base):
        return found
    # Points near each other lie in the same cell of a grid, or in neighbouring ones.
    low = base.min(0) - radius
    size = np.floor((base.max(0) - low) / radius).astype(np.int64) + 2
    inside = np.flatnonzero(((mapped > low) & (mapped < base.max(0) + radius)).all(1))
    queries = mapped[inside]
    query_cells = np.floor((queries - low) / radius).astype(np.int64)
    base_cells = np.floor((base - low) / radius).astype(np.int64)
    keys = base_cells[:, 1] * size[0] + base_cells[:, 0]
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    near = np.zeros(len(queries), bool)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            cells = query_cells + (dx, dy)
            valid = ((cells >= 0) & (cells < size)).all(1)
            wanted = np.where(valid, cells[:, 1] * size[0] + cells[:, 0], -1)
            first = np.searchsorted(sorted_keys, wanted, "left")
            last = np.searchsorted(sorted_keys, wanted, "right")
            rows = np.flatnonzero((last > first) & ~near)
            at = first[rows]
            while len(rows):
                distance = np.linalg.norm(queries[rows] - base[order[at]], axis=1)
                near[rows[distance < radius]] = True
                at = at + 1
                left = (at < last[rows]) & (distance >= radius)
                rows, at = rows[left], at[left]
    found[inside] = near
    return found


def published_repeatability(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray, radius: float = 1.0
) -> float:
    """Return the repeatability as the paper's code takes it, clipped at 1.

    The number of points of the first image that land strictly closer than `radius` to
    some point of the second, over the smaller of the two total counts: points outside the
    overlap count in the denominator, several points may share one, and nothing is
    corrected for chance, which is high at this density.

    Args:
        points0, points1: (N, 2), (M, 2) positions.
        homography: (3, 3) from the first image to the second.
        radius: in pixels.

    Returns:
        In [0, 1]; 0 where an image has no points.
    """
    fewest = min(len(points0), len(points1))
    if not fewest:
        return 0.0
    return min(np.count_nonzero(repeated(points0, points1, homography, radius)) / fewest, 1.0)
