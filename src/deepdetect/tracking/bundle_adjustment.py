"""Adjustment of the last keyframes and of the points that they see, by COLMAP (Ceres)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..geometry.camera import Camera
from ..sfm.colmap import PIXEL_CENTRE, quiet_pycolmap


@dataclass(eq=False)
class Keyframe:
    """A frame whose observations make the map; its pose and observations change.

    Attributes:
        number: of the frame.
        tracks: (N,) int64 numbers of the tracks that it sees, rising.
        xy: (N, 2) float64 where.
        used: (N,) bool, which of these observations are trusted.
        rotation: (3, 3) float64, world to camera.
        translation: (3,) float64, world to camera.
    """

    number: int
    tracks: np.ndarray
    xy: np.ndarray
    used: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """(3,) position of the camera."""
        return -self.rotation.T @ self.translation

    def forget_observations(self) -> None:
        """Keep the pose alone."""
        self.tracks, self.used = self.tracks[:0].copy(), self.used[:0].copy()
        self.xy = self.xy[:0].copy()

    def reprojection_errors(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return how far the points of its tracks are seen from where they are projected.

        Args:
            camera: of all frames.
            points: (N, 3) of its tracks; without a point not finite.

        Returns:
            (N,) float64 in pixels; infinite behind the camera, and without a point.
        """
        seen = points @ self.rotation.T + self.translation
        with np.errstate(invalid="ignore"):
            errors = np.linalg.norm(camera.project(seen) - self.xy, axis=1)
            return np.where((seen[:, 2] > 0) & np.isfinite(errors), errors, np.inf)


class MapPoints:
    """The points of tracks, by the numbers of these; of the tracks alone that were added and kept.

    Attributes:
        tracks: (T,) int64 numbers, rising.
        xyz: (T, 3) float64 points, NaN where a track has none.
        strikes: (T,) int64, how often the position of a track has not agreed with its point.

    Example:
        >>> points = MapPoints()
        >>> points.add(np.array([7, 3, 9]))
        >>> points.xyz[points.rows(np.array([7]))] = 1, 2, 3
        >>> points.keep(np.array([7, 9]))
        >>> points.tracks.tolist(), points.at(np.array([3, 7])).tolist()
        ([7, 9], [[nan, nan, nan], [1.0, 2.0, 3.0]])
    """

    def __init__(self) -> None:
        self.tracks = np.zeros(0, np.int64)
        self.xyz = np.zeros((0, 3))
        self.strikes = np.zeros(0, np.int64)

    def rows(self, tracks: np.ndarray) -> np.ndarray:
        """Return the rows of tracks that have been added."""
        return np.searchsorted(self.tracks, tracks)

    def at(self, tracks: np.ndarray) -> np.ndarray:
        """Return (N, 3) points of tracks, NaN where there is none."""
        points = np.full((len(tracks), 3), np.nan)
        if len(self.tracks):
            rows = self.rows(tracks).clip(max=len(self.tracks) - 1)
            known = self.tracks[rows] == tracks
            points[known] = self.xyz[rows[known]]
        return points

    def known(self) -> np.ndarray:
        """Return which rows have a point, (T,) bool."""
        return np.asarray(np.isfinite(self.xyz).all(axis=1))

    def add(self, tracks: np.ndarray) -> None:
        """Add tracks without a point; those that are there stay as they are."""
        new = np.setdiff1d(tracks, self.tracks)
        places = self.rows(new)
        self.tracks = np.insert(self.tracks, places, new)
        self.xyz = np.insert(self.xyz, places, np.nan, axis=0)
        self.strikes = np.insert(self.strikes, places, 0)

    def keep(self, tracks: np.ndarray) -> None:
        """Forget all tracks but these."""
        kept = np.isin(self.tracks, tracks)
        self.tracks, self.xyz = self.tracks[kept], self.xyz[kept]
        self.strikes = self.strikes[kept]


def adjust_keyframes(
    camera: Camera,
    keyframes: Sequence[Keyframe],
    points: MapPoints,
    fixed: int,
    robust_scale_px: float,
    max_iterations: int,
) -> None:
    """Adjust poses and points so that reprojection errors are small (Cauchy loss).

    Args:
        camera: of all frames.
        keyframes: with at least two views of each point that is to be adjusted; poses are changed.
        points: of the tracks that they see; changed.
        fixed: that many of the first keyframes stay where they are.
        robust_scale_px: larger errors count less.
        max_iterations: of the solver.
    """
    seen = _observations(keyframes, points)
    if not len(seen):
        return
    with quiet_pycolmap() as pycolmap:
        model = pycolmap.Reconstruction()
        (fx, fy), (cx, cy) = camera.focal_px, camera.centre
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=1,
                model="PINHOLE",
                width=camera.size[0],
                height=camera.size[1],
                params=[fx, fy, cx + PIXEL_CENTRE, cy + PIXEL_CENTRE],
            )
        )
        for k, keyframe in enumerate(keyframes):
            pose = pycolmap.Rigid3d(
                pycolmap.Rotation3d(keyframe.rotation), np.asarray(keyframe.translation)
            )
            # The places of an image's observations are those of the rows of its tracks.
            image = pycolmap.Image(
                name=str(k), keypoints=keyframe.xy + PIXEL_CENTRE, camera_id=1, image_id=k + 1
            )
            model.add_image_with_trivial_frame(image, pose)
        tracks, begins = np.unique(seen[:, 0], return_index=True)
        numbers = []
        places = points.rows(tracks)
        observed = np.split(seen[:, 1:], begins[1:])
        for xyz, rows in zip(points.xyz[places], observed, strict=True):
            elements = [pycolmap.TrackElement(view + 1, row) for view, row in rows.tolist()]
            numbers.append(model.add_point3D(xyz, pycolmap.Track(elements)))
        config = pycolmap.BundleAdjustmentConfig()
        for k in range(len(keyframes)):
            config.add_image(k + 1)
            if k < fixed:
                config.set_constant_rig_from_world_pose(k + 1)
        config.set_constant_cam_intrinsics(1)
        options = _options(pycolmap, robust_scale_px, max_iterations)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        for k, keyframe in enumerate(keyframes):
            pose = model.images[k + 1].cam_from_world()
            keyframe.rotation = pose.rotation.matrix()
            keyframe.translation = np.array(pose.translation)
        for place, number in zip(places.tolist(), numbers, strict=True):
            points.xyz[place] = model.points3D[number].xyz


def _options(pycolmap: Any, robust_scale_px: float, max_iterations: int) -> Any:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = robust_scale_px
    options.ceres.solver_options.max_num_iterations = max_iterations
    return options


def _observations(keyframes: Sequence[Keyframe], points: MapPoints) -> np.ndarray:
    """List (track, keyframe, row) of the points that two keyframes see, by track."""
    tables = []
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero(keyframe.used & np.isfinite(points.at(keyframe.tracks)).all(axis=1))
        tables.append(np.column_stack([keyframe.tracks[rows], np.full(len(rows), k), rows]))
    seen = np.concatenate(tables)
    _, inverse, counts = np.unique(seen[:, 0], return_inverse=True, return_counts=True)
    seen = seen[counts[inverse] >= 2]
    return seen[np.lexsort((seen[:, 1], seen[:, 0]))]
