"""Points that stand alone: statistical outlier removal.

Rusu et al., "Towards 3D point cloud based object maps for household environments", 2008, as in PCL
and Open3D: a point goes when its mean distance to its nearest neighbours is above the mean of all
by more than some standard deviations.

One bound for all asks for one spacing. Points of a stereo pair have it in the image and in
disparity, not in space, where their spacing across grows with the depth and along with its square:
in space the far points go first, and the wild ones among the near stay. So the distances are
measured in `disparity_space`; for a cloud from elsewhere `statistical_inliers` takes any space.
(Motorcycle's true disparities with 0.25 px of noise and 3 % random ones: 0.2 % of the good lost
and 93 % of the wild found, against 0.4 % and 88 % in space; a street of 2 to 125 baselines: 0 % and
96 %, against 1.8 % and 10 %.)
"""

from __future__ import annotations

import cv2
import numpy as np

from .._shared.errors import OptionError

NEIGHBOURS = 16
WINDOW = 9
FACTOR = 2.0

DISPARITY_WEIGHT = 2.0
"""Distance that a pixel of disparity counts beside a pixel in the image."""

SINGLE_TREE = 4
"""FLANN's number of the kd-tree that is exact in few dimensions."""


def statistical_inliers(
    points: np.ndarray, neighbours: int = NEIGHBOURS, factor: float = FACTOR
) -> np.ndarray:
    """Tell which points have others about them.

    Args:
        points: (N, 3) in a space where the spacing is about the same everywhere.
        neighbours: nearest points that are looked at.
        factor: standard deviations above the mean; fewer remove more.

    Returns:
        (N,) bool. Not finite points are outliers and count for no other.

    Raises:
        OptionError: there is no neighbour to look at, or the factor is negative.

    Example:
        >>> row = np.column_stack([np.arange(100.0), np.zeros(100), np.zeros(100)])
        >>> row[50, 1] = 30
        >>> np.flatnonzero(~statistical_inliers(row, 4)).tolist()
        [50]
    """
    if neighbours < 1:
        raise OptionError(f"neighbours must be at least 1, not {neighbours}")
    if not factor >= 0:
        raise OptionError(f"the factor of the standard deviation must not be negative: {factor}")
    points = np.asarray(points).reshape(-1, 3)
    inliers = np.isfinite(points).all(1)
    if np.count_nonzero(inliers) > 1:
        distances = mean_neighbour_distances(points[inliers], neighbours)
        inliers[inliers] = distances <= distances.mean() + factor * distances.std()
    return inliers


def statistical_inliers_on_grid(
    pixels: np.ndarray,
    disparity: np.ndarray,
    size: tuple[int, int],
    window: int = WINDOW,
    factor: float = FACTOR,
) -> np.ndarray:
    """Tell which keypoints of a rectified pair have about the depth of those around.

    As `statistical_inliers`, with all keypoints in a window as neighbours and the root mean square
    of the differences of disparity as distance: three box filters, however many points there are.

    Args:
        pixels: (N, 2) whole pixels of the left image.
        disparity: (N,) in pixels.
        size: (width, height) of the image.
        window: side of the window in pixels.
        factor: standard deviations above the mean; fewer remove more.

    Returns:
        (N,) bool. A keypoint with no other in its window is an outlier only where most have some.

    Example:
        >>> pixels = np.argwhere(np.ones((20, 20)))
        >>> disparity = np.full(400, 7.0)
        >>> disparity[210] = 9
        >>> np.flatnonzero(~statistical_inliers_on_grid(pixels, disparity, (20, 20))).tolist()
        [210]
    """
    if not len(pixels):
        return np.ones(0, bool)
    columns, rows = np.rint(pixels).astype(np.int64).T
    middle = float(np.median(disparity))  # float32 squares of large numbers lose the differences
    centred = (disparity - middle).astype(np.float64)

    def around(values: np.ndarray | float) -> np.ndarray:
        image = np.zeros(size[::-1])
        image[rows, columns] = values
        kernel = (window, window)
        summed = cv2.boxFilter(image, -1, kernel, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return summed[rows, columns]

    others = around(1.0) - 1
    total, squares = around(centred), around(centred**2)
    differences = squares - 2 * centred * total + (others + 1) * centred**2
    distances = np.sqrt(np.maximum(differences, 0) / np.maximum(others, 1))
    some = others > 0.5
    if not some.any():
        return np.ones(len(pixels), bool)
    bound = distances[some].mean() + factor * distances[some].std()
    alone = ~some & (some.mean() > 0.5)
    return (distances <= bound + 1e-6) & ~alone


def mean_neighbour_distances(points: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Return the mean distance of each point to its nearest others, (N,) float64.

    By OpenCV's FLANN, whose single kd-tree is exact and, on 850,000 points of a surface, faster
    than SciPy's on two cores; and it is there anyway.

    Args:
        points: (N, 3) finite, N >= 2.
        neighbours: how many others; all when there are no more.
    """
    points = np.asarray(points, np.float64)
    centred = np.ascontiguousarray(points - points.mean(0), np.float32)
    count = min(neighbours + 1, len(points))
    tree = cv2.flann_Index(centred, {"algorithm": SINGLE_TREE, "leaf_max_size": 10})
    _, squares = tree.knnSearch(centred, count, params={"checks": -1})
    # The nearest is the point itself, or one in the same place.
    return np.sqrt(squares[:, 1:].astype(np.float64)).mean(1)


def disparity_space(points: np.ndarray, focal_px: float, baseline: float = 1.0) -> np.ndarray:
    """Return points as (x, y, weight * disparity) in pixels of the first camera.

    Args:
        points: (N, 3) in its frame, z above 0.
        focal_px: its focal length.
        baseline: in the units of the points.

    Returns:
        (N, 3) float64.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = points[:, :2] / points[:, 2:] * focal_px
        disparity = focal_px * baseline / points[:, 2]
    return np.column_stack([across, DISPARITY_WEIGHT * disparity])
