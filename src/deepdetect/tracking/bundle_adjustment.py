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


def adjust_keyframes(
    camera: Camera,
    keyframes: Sequence[Keyframe],
    points: np.ndarray,
    fixed: int,
    robust_scale_px: float,
    max_iterations: int,
) -> None:
    """Adjust poses and points so that reprojection errors are small (Cauchy loss).

    Args:
        camera: of all frames.
        keyframes: with at least two views of each point that is to be adjusted; poses are changed.
        points: (T, 3) by the number of the track, not finite where there is none; changed.
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
        for track, rows in zip(tracks.tolist(), np.split(seen[:, 1:], begins[1:]), strict=True):
            elements = [pycolmap.TrackElement(view + 1, row) for view, row in rows.tolist()]
            numbers.append(model.add_point3D(points[track], pycolmap.Track(elements)))
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
        for track, number in zip(tracks.tolist(), numbers, strict=True):
            points[track] = model.points3D[number].xyz


def _options(pycolmap: Any, robust_scale_px: float, max_iterations: int) -> Any:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = robust_scale_px
    options.ceres.solver_options.max_num_iterations = max_iterations
    return options


def _observations(keyframes: Sequence[Keyframe], points: np.ndarray) -> np.ndarray:
    """List (track, keyframe, row) of the points that two keyframes see, by track."""
    tables = []
    for k, keyframe in enumerate(keyframes):
        rows = np.flatnonzero(keyframe.used & np.isfinite(points[keyframe.tracks]).all(axis=1))
        tables.append(np.column_stack([keyframe.tracks[rows], np.full(len(rows), k), rows]))
    seen = np.concatenate(tables)
    _, inverse, counts = np.unique(seen[:, 0], return_inverse=True, return_counts=True)
    seen = seen[counts[inverse] >= 2]
    return seen[np.lexsort((seen[:, 1], seen[:, 0]))]
