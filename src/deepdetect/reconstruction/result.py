"""The result of a reconstruction of two images: 3D points and statistics, and its files."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.options import suggest_keywords
from .._shared.records import save_arrays
from ..geometry.camera import Calibration, Camera, angles_between
from ..geometry.point_cloud import PointCloud
from ..geometry.relative_pose import RelativePose
from ..io.depth import save_depth_png
from ..io.picture_file import save_picture
from ..io.point_cloud import POINT_CLOUD_WRITERS, save_point_cloud
from ..viz.draw import draw_depth
from .rectification import Rectification

ENDINGS = (*POINT_CLOUD_WRITERS, "_depth.png", "_depth.npz", "_depth.jpg", ".json")

PERCENTILES = (0, 5, 25, 50, 75, 95, 100)

SCALE = {
    "mm": "lengths are in mm",
    "baseline": "lengths are in baselines: the true scale is not known (give baseline_mm in a "
    "calib.json)",
}

SHAPE = "; if the cameras differ in cx, depths are wrong unless disparity_offset_px is given"
"""Warning for rectified pairs whose calibration does not state the disparity offset."""


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """3D points from two images, and how they were found.

    Attributes:
        points: (N, 3) float32 in the frame of the left camera: x right, y down, z forward.
        colors: (N, 3) uint8 sRGB of the left image.
        pixels: (N, 2) float32 positions of the points in the left image.
        disparity: (N,) float32 in pixels for rectified pairs, else None. The match of (x, y) in
            the left image is (x - disparity, y) in the right image.
        matched: (N,) bool, True for points that were matched in both images. All other points are
            hidden in the right image or at the edge of an occluding surface, and have the depth of
            an adjacent surface. They exist only if every pixel of a rectified pair becomes a point.
        unit: "mm" if the baseline is known. Otherwise "baseline": the distance between the cameras
            is 1, and the true scale is not known.
        size: (width, height) of the left image.
        rectified: whether the pair was treated as rectified.
        rectification: the numbers on which `rectified` is based; None if the caller set it.
        calibration: intrinsics and baseline of the cameras.
        pose: pose of the right camera if the pair is not rectified, else None.
        reprojection_errors: (N,) float32 root mean square distances, in pixels, of the projected
            points from the matched positions in both images; None for rectified pairs.
        keypoints: number of keypoints in the left image.
        matches: number of matches that were triangulated.
        dropped: number of matches that each check removed, in the order of the checks.
        seconds: time that each stage took.
        left_out: share of the image that was ignored because it stands still while the scene moves.
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
    left_out: float = 0.0

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        pair = "rectified" if self.rectified else "not rectified"
        low, high = np.percentile(self.points[:, 2], (5, 95)) if len(self) else (np.nan, np.nan)
        return (
            f"Reconstruction({len(self):,} points, {pair}, depth {low:.4g} to {high:.4g} "
            f"{self.unit}, {self.size[0]}x{self.size[1]})"
        )

    @property
    def cloud(self) -> PointCloud:
        """The points with their colours, to save or draw."""
        return PointCloud(self.points, self.colors, self.unit)

    @property
    def baseline_vector(self) -> np.ndarray:
        """Vector from the left camera centre to the right one, (3,), in the left camera's frame."""
        length = 1.0 if self.calibration.baseline_mm is None else self.calibration.baseline_mm
        if self.pose is None:
            return np.array([length, 0, 0])
        return -length * (self.pose.rotation.T @ self.pose.translation)

    def triangulation_angles(self) -> np.ndarray:
        """Return the angle at each point between the rays to the two cameras, (N,) in degrees."""
        points = self.points.astype(np.float64)
        return np.degrees(angles_between(points, points - self.baseline_vector))

    def depth_map(self) -> np.ndarray:
        """Return the depth at each pixel of the left image, (H, W) float32; NaN if unknown."""
        return self._map(self.points[:, 2])

    def disparity_map(self) -> np.ndarray:
        """Return the disparity at each pixel of the left image, (H, W) float32; NaN if unknown.

        Raises:
            ReconstructionError: the pair is not rectified.
        """
        if self.disparity is None:
            raise ReconstructionError("only rectified pairs have disparities: use depth_map()")
        return self._map(self.disparity)

    def matched_map(self) -> np.ndarray:
        """Return (H, W) bool, True for pixels whose point was matched in both images."""
        return self._map(self.matched.astype(np.float32)) == 1

    def summary(self) -> dict[str, Any]:
        """Return plain values for JSON, with statistics of the arrays; NaN becomes None."""
        errors, disparity = self.reprojection_errors, self.disparity
        rows, pose, calibration = self.rectification, self.pose, self.calibration
        cameras = {"left": calibration.camera0, "right": calibration.camera1}
        unsaid = self.rectified and calibration.camera0 == calibration.camera1
        unsaid &= calibration.baseline_mm is None
        why = "set by the caller"
        if rows is not None:
            on_rows = f"{rows.on_rows:,} of {rows.matches:,} sparse matches are on the same row"
            why = rows.reason or on_rows
        return {
            "points": len(self),
            "filled": int(np.count_nonzero(~self.matched)),
            "keypoints": self.keypoints,
            "matches": self.matches,
            "dropped": dict(self.dropped),
            "left_out": round(self.left_out, 4),
            "width": self.size[0],
            "height": self.size[1],
            "density": round(len(self) / (self.size[0] * self.size[1]), 6),
            "rectified": self.rectified,
            "rectified_why": why,
            "rectification": None if rows is None else _finite(dataclasses.asdict(rows)),
            "unit": self.unit,
            "scale": SCALE[self.unit] + (SHAPE if unsaid else ""),
            "depth": _percentiles(self.points[:, 2]),
            "disparity": None if disparity is None else _percentiles(disparity),
            "median_triangulation_angle_degrees": _median(self.triangulation_angles()),
            "median_reprojection_error_px": None if errors is None else _median(errors),
            "pose": None
            if pose is None
            else {
                "rotation": pose.rotation.tolist(),
                "translation": pose.translation.tolist(),
                "angle_degrees": round(pose.angle, 4),
                "in_front": round(pose.cheirality_ratio, 4),
            },
            "calibration": {
                "source": calibration.source,
                "baseline_mm": calibration.baseline_mm,
                "disparity_offset_px": round(calibration.disparity_offset_px, 6),
            }
            | {side: _camera_values(camera) for side, camera in cameras.items()},
            "seconds": {stage: round(value, 4) for stage, value in self.seconds.items()},
        }

    def _map(self, values: np.ndarray) -> np.ndarray:
        """Return an (H, W) float32 map of the points' values at their pixels, NaN elsewhere."""
        result = np.full(self.size[::-1], np.nan, np.float32)
        columns, rows = np.rint(self.pixels).astype(np.int64).T
        result[rows, columns] = values
        return result


def _camera_values(camera: Camera) -> dict[str, Any]:
    (width, height), (cx, cy) = camera.size, camera.centre
    focal_px = list(camera.focal_px)
    return {"width": width, "height": height, "focal_px": focal_px, "cx": cx, "cy": cy}


def _median(values: np.ndarray) -> float:
    return round(float(np.median(values)), 4)


def _percentiles(values: np.ndarray) -> dict[str, float]:
    found = np.percentile(values.astype(np.float64), PERCENTILES)
    return {
        f"{percent}%": float(f"{value:.6g}")
        for percent, value in zip(PERCENTILES, found, strict=True)
    }


def _finite(value: Any) -> Any:
    """Replace numbers that are not finite by None, because JSON cannot represent them."""
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def save_reconstruction(
    found: Reconstruction, paths: Mapping[str, Path], title: str, **values: Any
) -> dict[str, Any]:
    """Write a file for each of `ENDINGS`; return what the JSON contains, including `values`."""
    started = time.perf_counter()
    summary = found.summary()
    notes = {
        "title": title,
        "pair": "rectified" if found.rectified else "not rectified",
        "calibration": found.calibration.source,
        "scale": summary["scale"],
    }
    for ending in POINT_CLOUD_WRITERS:
        save_point_cloud(found.cloud, paths[ending], notes)
    depth = found.depth_map()
    stored = save_depth_png(depth, paths["_depth.png"], found.unit)
    arrays: dict[str, Any] = {"depth": depth, "unit": found.unit, "matched": found.matched_map()}
    arrays |= {} if found.disparity is None else {"disparity": found.disparity_map()}
    save_arrays(paths["_depth.npz"], arrays)
    save_picture(draw_depth(depth, found.unit), paths["_depth.jpg"])
    summary["seconds"]["files"] = round(time.perf_counter() - started, 4)
    numbers = {**summary, "depth_png": stored, **values}
    text = json.dumps(numbers, indent=2, default=str) + "\n"
    paths[".json"].write_text(text, encoding="utf-8")
    return numbers
