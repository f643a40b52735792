"""Coloured 3D points, and the box that contains most of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.errors import OptionError, check_name
from .._shared.options import suggest_keywords

UNITS = {
    "m": "metres",
    "mm": "millimetres",
    "baseline": "baselines (1 = the distance between the two cameras)",
    "spacing": "spacings (1 = the median distance from a camera to the nearest other one)",
}
"""Units of length, and their descriptions in files. "baseline" and "spacing" are not metric."""

EAST_NORTH_UP = "x east, y north, z up"
"""`PointCloud.frame` of a georeferenced cloud. Any other value is the name of a camera."""

BOX_PERCENTILE, MAX_ANGULAR_SPACING = 1.0, 0.02
"""BOX_PERCENTILE percent of the points lie beyond each face of the robust box. MAX_ANGULAR_SPACING,
the maximum of `angular_spacing` in radians, limits the size of drawn points. Chosen by hand."""


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """Coloured 3D points in the frame of a camera, or georeferenced (frame `EAST_NORTH_UP`).

    Attributes:
        points: (N, 3) float32 or float64 positions. In the frame of a camera x is right, y down,
            and z forward, and the camera's centre is (0, 0, 0).
        colors: (N, 3) uint8 sRGB.
        unit: "mm", "m", "baseline" (the distance between the two cameras) or "spacing" (the median
            distance from one of many cameras to the nearest other).
        frame: name of the camera in whose frame the points are, or `EAST_NORTH_UP`.
        normals: (N, 3) float32 unit vectors, which point towards the cameras, or None.

    A cloud has a `len`, and can be indexed by slices, masks and index arrays.

    Raises:
        OptionError: a shape or type is wrong, a coordinate is not finite or exceeds the range of
            float32, which files use, or the unit is unknown.

    Example:
        >>> cloud = PointCloud([[0.0, 0.0, 900.0], [8.0, 2.0, 950.0]], [[9, 9, 9], [7, 7, 7]], "mm")
        >>> len(cloud), cloud[cloud.points[:, 2] > 910].colors.tolist()
        (2, [[7, 7, 7]])
    """

    points: np.ndarray
    colors: np.ndarray
    unit: str
    frame: str = "left camera"
    normals: np.ndarray | None = None

    def __post_init__(self) -> None:
        check_name("unit", self.unit, UNITS)
        points, colors = np.asarray(self.points), np.asarray(self.colors)
        if points.size == colors.size == 0:
            points, colors = np.empty((0, 3)), np.empty((0, 3), np.uint8)
        if points.ndim != 2 or points.shape[1] != 3 or colors.shape != points.shape:
            raise OptionError(
                f"points and colors must be (N, 3), not {points.shape} and {colors.shape}"
            )
        if points.dtype not in (np.float32, np.float64):
            raise OptionError(f"points must be float32 or float64, not {points.dtype}")
        if colors.dtype != np.uint8:
            if colors.dtype.kind not in "iu" or colors.min() < 0 or colors.max() > 255:
                raise OptionError(f"colors must be whole numbers from 0 to 255, not {colors.dtype}")
            colors = colors.astype(np.uint8)
        if self.normals is not None:
            normals = np.asarray(self.normals, np.float32)
            if normals.shape != points.shape:
                raise OptionError(f"normals must be {points.shape}, not {normals.shape}")
            object.__setattr__(self, "normals", normals)
        # NaN fails this comparison, so it is also rejected.
        if not (np.abs(points) < np.finfo(np.float32).max).all():
            raise OptionError("every coordinate of a point must be finite: remove the other points")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "colors", colors)

    def __repr__(self) -> str:
        return f"PointCloud({len(self):,} points, unit={self.unit!r})"

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, index: slice | np.ndarray | list[int]) -> PointCloud:
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        normals = None if self.normals is None else self.normals[index]
        return PointCloud(self.points[index], self.colors[index], self.unit, self.frame, normals)

    @property
    def axes(self) -> str:
        """The description of the frame and its axes that is written to files."""
        if self.frame == EAST_NORTH_UP:
            return self.frame
        return f"{self.frame}, x right, y down, z forward, origin at its centre"


@dataclass(frozen=True, eq=False)
class RobustBox:
    """An axis-aligned box, from corner `low` to `high`, around all points but the outermost."""

    low: np.ndarray
    high: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """Centre of the box, (3,) float64."""
        return (self.low + self.high) / 2

    @property
    def radius(self) -> float:
        """Half the diagonal of the box; 1 if the box is a single point."""
        return float(np.linalg.norm(self.high - self.low)) / 2 or 1.0


def robust_box(cloud: PointCloud) -> RobustBox:
    """Find the box from the 1st to the 99th percentile of each coordinate.

    A few distant outliers hardly change the box. An empty cloud raises an OptionError.
    """
    require_points(cloud)
    ends = BOX_PERCENTILE, 100 - BOX_PERCENTILE
    return RobustBox(*np.percentile(cloud.points.astype(np.float64), ends, axis=0))


def angular_spacing(cloud: PointCloud) -> float:
    """Return the angle between neighbouring points as seen by the left camera, in radians.

    It is estimated as if the points were spread evenly over the view. If points are drawn with this
    angular width, a dense cloud looks like a closed surface. An empty cloud raises an OptionError.
    """
    require_points(cloud)
    ahead = cloud.points[cloud.points[:, 2] > 0]
    if not len(ahead):
        return MAX_ANGULAR_SPACING
    ends = BOX_PERCENTILE, 100 - BOX_PERCENTILE
    seen = np.percentile(ahead[:, :2] / ahead[:, 2:], ends, axis=0)
    width, height = ((seen[1] - seen[0]) / (1 - 2 * BOX_PERCENTILE / 100)).tolist()
    spacing = min(MAX_ANGULAR_SPACING, float(np.sqrt(width * height / len(ahead))))
    return spacing or MAX_ANGULAR_SPACING


def require_points(cloud: PointCloud) -> None:
    """Raise an OptionError for an empty cloud."""
    if not len(cloud):
        raise OptionError("the point cloud has no points: there is nothing to show or to write")
