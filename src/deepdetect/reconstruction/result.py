"""What two photographs gave: points in space, and all that is known of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.errors import ReconstructionError
from ..geometry.camera import Calibration
from ..geometry.point_cloud import PointCloud
from ..geometry.relative_pose import RelativePose
from .rectification import Rectification


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Points in space, and where they come from.

    Attributes:
        points: (N, 3) float32 in the frame of the left camera: x right, y down, z forward.
        colors: (N, 3) uint8 sRGB, of the left image.
        pixels: (N, 2) float32, where each point lies in the left image.
        disparity: (N,) float32 in pixels for rectified pairs, else None: the match of the left
            (x, y) is the right (x - disparity, y).
        matched: (N,) bool: seen in both images; False for points that were filled in (only when
            every pixel of a rectified pair is asked for).
        unit: "mm" when the baseline is known, else "baseline": the distance of the cameras is 1,
            and the true scale is not known.
        size: (width, height) of the left image.
        rectified: which road was taken.
        rectification: the figures by which it was chosen; None when it was asked for.
        calibration: of the cameras.
        pose: of the right camera for pairs that are not rectified, else None.
        reprojection_errors: (N,) float32 for pairs that are not rectified, else None: how far
            points are seen from their matches, in pixels (root mean square of both images).
        keypoints: number of keypoints in the left image.
        matches: number of matches that the points were made from.
        dropped: how many of these each check took away, in order.
        seconds: time of each stage.
    """

    points: np.ndarray
    colors: np.ndarray
    pixels: np.ndarray
    disparity: np.ndarray | None
    matched: np.ndarray
    unit: str
    size: tuple[int, int]
    rectified: bool
    rectification: Rectification | None
    calibration: Calibration
    pose: RelativePose | None
    reprojection_errors: np.ndarray | None
    keypoints: int
    matches: int
    dropped: dict[str, int]
    seconds: dict[str, float]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def cloud(self) -> PointCloud:
        """The points with their colours, for the exporters."""
        return PointCloud(self.points, self.colors, self.unit)

    @property
    def right_centre(self) -> np.ndarray:
        """Where the right camera stands, (3,) float64 in the frame and unit of the points."""
        length = 1.0 if self.calibration.baseline_mm is None else self.calibration.baseline_mm
        if self.pose is None:
            return np.array([length, 0, 0])
        return -length * (self.pose.rotation.T @ self.pose.translation)

    def parallax(self) -> np.ndarray:
        """Return the angle at each point between both cameras, (N,) float64 in degrees."""
        points = self.points.astype(np.float64)
        there = points - self.right_centre
        across = np.linalg.norm(np.cross(points, there), axis=1)
        return np.degrees(np.arctan2(across, np.einsum("ij,ij->i", points, there)))

    def depth_map(self) -> np.ndarray:
        """Return the depth at each pixel of the left image, (H, W) float32; NaN where unknown."""
        return self._map(self.points[:, 2])

    def disparity_map(self) -> np.ndarray:
        """Return the disparity at each pixel of the left image; NaN where it is unknown.

        Raises:
            ReconstructionError: the pair is not rectified.
        """
        if self.disparity is None:
            raise ReconstructionError("only rectified pairs have disparities: take the depth map")
        return self._map(self.disparity)

    def matched_map(self) -> np.ndarray:
        """Return (H, W) bool: pixels whose point was seen in both images, and not filled in."""
        return self._map(self.matched.astype(np.float32)) == 1

    def _map(self, values: np.ndarray) -> np.ndarray:
        result = np.full(self.size[::-1], np.nan, np.float32)
        columns, rows = np.rint(self.pixels).astype(np.int64).T
        result[rows, columns] = values
        return result
