"""Monocular visual odometry of a calibrated camera, from tracks of points in its video.

Two frames with enough motion give the first pose and points (essential matrix, triangulation). The
pose of each later frame is estimated from the points that it sees (PnP), and keyframes add points.
The last keyframes and their points are refined by bundle adjustment, which keeps the scale
consistent. COLMAP estimates poses and adjusts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from deepdetect import Calibration, Camera
from deepdetect.geometry.relative_pose import triangulate
from deepdetect.sfm.colmap import PIXEL_CENTRE, CameraIntrinsics, import_pycolmap, quiet_pycolmap
from deepdetect.tracking import TrackedFrame

pycolmap = import_pycolmap("visual odometry")

# All of these numbers are chosen by hand.
MIN_MOTION_PX = 5.0  # a new keyframe needs this median motion of the tracks
MIN_FIRST_MOTION_PX = 15.0  # the two frames of the first points need this median motion
MIN_TRACKED = 0.7  # a frame that sees a smaller share of the last keyframe's points is a keyframe
MAX_ERROR_PX = 2.0  # reprojection error of inliers
MIN_INLIERS = 20  # a pose needs this many inliers
MIN_FIRST_POINTS = 50  # the first two frames need this many points
MIN_ANGLE_DEG = 1.0  # the rays to a new point must form this angle
WINDOW = 10  # number of keyframes in an adjustment
ANCHORS = 5  # number of fixed keyframes before them
ROBUST_SCALE_PX = 0.5  # scale of the adjustment's Cauchy loss
MAX_ITERATIONS = 10  # iterations of the adjustment
MAX_STRIKES = 2  # a track that is an outlier this often may be on a moving object: it is left out


@dataclass(eq=False)
class Keyframe:
    """A frame whose observations belong to the map, and its pose, world to camera."""

    frame: TrackedFrame
    pose: pycolmap.Rigid3d


class VisualOdometry:
    """Estimates the path of a camera, frame by frame.

    The world frame is that of the first camera. The unit is the distance between the two frames of
    the first points. If no pose can be found, it starts again with another path, which has a world
    frame and a unit of its own.

    Args:
        camera: camera of all frames, without distortion.

    Attributes:
        lost: numbers of the frames whose pose could not be estimated from earlier points.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.lost: list[int] = []
        self._colmap_camera = CameraIntrinsics.of_camera(camera).colmap_camera()
        self._colmap_camera.camera_id = 1
        self._waiting: list[TrackedFrame] = []
        self._keyframes: list[Keyframe] = []
        self._placed: list[tuple[int, int, pycolmap.Rigid3d]] = []  # frame, keyframe, from it
        self._before: list[tuple[np.ndarray, np.ndarray]] = []  # paths before the camera was lost
        self._points = np.empty((0, 3))  # by track number, NaN without a point
        self._strikes = np.empty(0, np.int64)

    def update(self, frame: TrackedFrame) -> bool:
        """Estimate the pose of the next frame; return whether it has one.

        The first frames get their poses once the camera has moved enough.
        """
        new = int(frame.tracks.max(initial=-1)) + 1 - len(self._points)
        if new > 0:
            self._points = np.concatenate([self._points, np.full((new, 3), np.nan)])
            self._strikes = np.append(self._strikes, np.zeros(new, np.int64))
        with quiet_pycolmap():
            if self._keyframes and not self._place(frame):
                self.lost.append(frame.number)
                self._before = self.trajectories()
                self._keyframes, self._placed, self._waiting = [], [], []
            if not self._keyframes:
                self._waiting.append(frame)
                return self._begin()
        return True

    def trajectories(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (F,) frame numbers and (F, 3, 4) float64 poses, camera to world, of each path.

        If the camera was never lost, there is at most one path.
        """
        poses = [
            (relative * self._keyframes[keyframe].pose).inverse().matrix()
            for _, keyframe, relative in self._placed
        ]
        numbers = [number for number, _, _ in self._placed]
        return [*self._before, (np.array(numbers), np.array(poses))] if poses else self._before

    def _begin(self) -> bool:
        """Triangulate the first points if the camera has moved enough since the first frame."""
        last = self._waiting[-1]
        for first in tuple(self._waiting):
            tracks, rows0, rows1 = np.intersect1d(first.tracks, last.tracks, True, True)
            if len(tracks) >= MIN_FIRST_POINTS:
                break
            del self._waiting[0]  # too few common tracks: start with a later frame
        else:
            return False
        xy0, xy1 = first.xy[rows0].astype(float), last.xy[rows1].astype(float)
        if np.median(np.linalg.norm(xy1 - xy0, axis=1)) < MIN_FIRST_MOTION_PX:
            return False
        options = pycolmap.TwoViewGeometryOptions(compute_relative_pose=True)
        options.min_num_inliers = MIN_INLIERS
        options.ransac.max_error = MAX_ERROR_PX / 2
        options.ransac.random_seed = 0
        matches = np.repeat(np.arange(len(tracks), dtype=np.uint32)[:, None], 2, axis=1)
        places = (self._colmap_camera, xy0 + PIXEL_CENTRE, self._colmap_camera, xy1 + PIXEL_CENTRE)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(*places, matches, options)
        agreeing = geometry.inlier_matches[:, 0]
        if len(agreeing) < MIN_INLIERS or geometry.cam2_from_cam1 is None:
            return False
        keyframes = [Keyframe(first, pycolmap.Rigid3d())]
        keyframes.append(Keyframe(last, geometry.cam2_from_cam1))
        self._points[:], self._strikes[:] = np.nan, 0
        self._triangulate(*keyframes, tracks[agreeing], MAX_ERROR_PX)
        if np.isfinite(self._points[:, 0]).sum() < MIN_FIRST_POINTS:
            return False
        self._keyframes = keyframes
        self._adjust()
        self._placed.append((first.number, 0, pycolmap.Rigid3d()))
        for frame in self._waiting[1:-1]:
            pose = self._solve(frame)
            if pose is not None:
                self._placed.append((frame.number, 0, pose))
        self._placed.append((last.number, 1, pycolmap.Rigid3d()))
        return True

    def _place(self, frame: TrackedFrame) -> bool:
        """Estimate the pose of a frame from the points that it sees; add keyframes when needed."""
        pose = self._solve(frame)
        if pose is None:
            return False
        outliers = self._errors(frame, pose) >= MAX_ERROR_PX
        self._strikes[frame.tracks[outliers & self._known(frame)]] += 1
        self._points[self._strikes >= MAX_STRIKES] = np.nan
        last = self._keyframes[-1]
        _, rows0, rows1 = np.intersect1d(last.frame.tracks, frame.tracks, True, True)
        motion = np.linalg.norm(last.frame.xy[rows0] - frame.xy[rows1], axis=1)
        known = self._known(last.frame)
        tracked = known[rows0].sum() / max(1, known.sum())
        if tracked >= MIN_TRACKED and np.median(motion) < MIN_MOTION_PX:
            self._placed.append(
                (frame.number, len(self._keyframes) - 1, pose * last.pose.inverse())
            )
            return True
        new = Keyframe(frame, pose)
        self._keyframes.append(new)
        self._placed.append((frame.number, len(self._keyframes) - 1, pycolmap.Rigid3d()))
        for keyframe in self._keyframes[-WINDOW:-1]:
            unknown = frame.tracks[
                ~self._known(frame) & (self._strikes[frame.tracks] < MAX_STRIKES)
            ]
            common = np.intersect1d(keyframe.frame.tracks, unknown, True)
            self._triangulate(keyframe, new, common, MAX_ERROR_PX / 2)
        self._adjust()
        return True

    def _known(self, frame: TrackedFrame) -> np.ndarray:
        """Return whether each track of a frame has a point."""
        return np.isfinite(self._points[frame.tracks, 0])

    def _errors(self, frame: TrackedFrame, pose: pycolmap.Rigid3d) -> np.ndarray:
        """Return reprojection errors of a frame's tracks: infinite behind it, NaN if unknown."""
        matrix = pose.matrix()
        seen = self._points[frame.tracks] @ matrix[:, :3].T + matrix[:, 3]
        with np.errstate(invalid="ignore"):
            errors = np.linalg.norm(self.camera.project(seen) - frame.xy, axis=1)
        return np.where(seen[:, 2] <= 0, np.inf, errors)

    def _solve(self, frame: TrackedFrame) -> pycolmap.Rigid3d | None:
        """Return a frame's pose estimated from the points that it sees, or None."""
        known = self._known(frame)
        if known.sum() < MIN_INLIERS:
            return None
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac.max_error = MAX_ERROR_PX
        options.ransac.random_seed = 0
        xy, points = frame.xy[known] + PIXEL_CENTRE, self._points[frame.tracks[known]]
        found = pycolmap.estimate_and_refine_absolute_pose(xy, points, self._colmap_camera, options)
        if found is None or found["num_inliers"] < MIN_INLIERS:
            return None
        return found["cam_from_world"]

    def _triangulate(
        self, first: Keyframe, second: Keyframe, tracks: np.ndarray, max_error_px: float
    ) -> None:
        """Triangulate tracks that two keyframes see, and keep points whose rays agree."""
        if not len(tracks):
            return
        relative = second.pose * first.pose.inverse()
        xy0, xy1 = (
            each.frame.xy[np.searchsorted(each.frame.tracks, tracks)].astype(float)
            for each in (first, second)
        )
        calibration = Calibration(self.camera, self.camera)
        found = triangulate(xy0, xy1, calibration, relative.rotation.matrix(), relative.translation)
        good = (
            found.cheirality
            & (found.triangulation_angle > np.radians(MIN_ANGLE_DEG))
            & (found.reprojection_errors < max_error_px)
        )
        matrix = first.pose.inverse().matrix()
        self._points[tracks[good]] = found.points[good] @ matrix[:, :3].T + matrix[:, 3]

    def _adjust(self) -> None:
        """Adjust the last keyframes and their points, and remove outliers."""
        window = self._keyframes[-WINDOW - ANCHORS :]
        seen_by: dict[int, list[tuple[int, int]]] = {}
        for k, keyframe in enumerate(window, 1):
            used = self._errors(keyframe.frame, keyframe.pose) < MAX_ERROR_PX
            for row in np.flatnonzero(used).tolist():
                seen_by.setdefault(int(keyframe.frame.tracks[row]), []).append((k, row))
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(self._colmap_camera)
        config = pycolmap.BundleAdjustmentConfig()
        config.set_constant_cam_intrinsics(1)
        for k, keyframe in enumerate(window, 1):
            xy = keyframe.frame.xy + PIXEL_CENTRE
            image = pycolmap.Image(name=str(k), keypoints=xy, camera_id=1, image_id=k)
            model.add_image_with_trivial_frame(image, keyframe.pose)
            config.add_image(k)
            if k <= max(1, len(window) - WINDOW):
                config.set_constant_rig_from_world_pose(k)
        numbers = {}
        for track, places in seen_by.items():
            if len(places) > 1:
                elements = [pycolmap.TrackElement(k, row) for k, row in places]
                numbers[track] = model.add_point3D(self._points[track], pycolmap.Track(elements))
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary = False
        options.refine_focal_length = options.refine_extra_params = False
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = ROBUST_SCALE_PX
        options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
        if len(window) <= WINDOW + 1:  # a single fixed camera leaves the scale free
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        for k, keyframe in enumerate(window, 1):
            keyframe.pose = model.images[k].cam_from_world()
        for track, number in numbers.items():
            self._points[track] = model.points3D[number].xyz
        counts = np.zeros(len(self._points), np.int64)
        for keyframe in window:
            used = self._errors(keyframe.frame, keyframe.pose) < MAX_ERROR_PX
            counts[keyframe.frame.tracks[used]] += 1
        recent = np.unique(np.concatenate([keyframe.frame.tracks for keyframe in window]))
        self._points[recent[counts[recent] < 2]] = np.nan
