"""The path of a calibrated camera from the tracks of its video (monocular visual odometry).

Two frames with enough motion give the first pose and points: essential matrix (MAGSAC),
triangulation. From then on each frame is placed by the points that it sees (PnP), keyframes add
points, and the last keyframes are adjusted together with their points, so that the scale, which one
camera cannot know, stays that of the beginning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from ..geometry.camera import Calibration, Camera
from ..geometry.relative_pose import estimate_relative_pose
from ..geometry.triangulation import triangulate
from ..sfm.colmap import import_pycolmap
from .bundle_adjustment import Keyframe, MapPoints, adjust_keyframes
from .tracks import TrackedFrame, common_rows
from .trajectory import Trajectory

PNP_ITERATIONS = 200
PNP_CONFIDENCE = 0.999


@suggest_keywords
@dataclass(frozen=True)
class OdometryOptions:
    """How the path of a camera is estimated.

    Attributes:
        min_motion_px: median motion of the tracks from one keyframe to the next.
        min_first_motion_px: of those between the two frames that make the first points.
        min_tracked: share of the points of the last keyframe; a frame that sees fewer is a
            keyframe, whatever the motion.
        max_error_px: of a position that agrees with a pose and a point.
        min_inliers: points that must agree with a pose.
        min_angle_deg: between the rays to a new point.
        window: keyframes that are adjusted together.
        anchors: keyframes before these which see the same points, and stay where they are.
        robust_scale_px: of the adjustment's loss (Cauchy): larger errors count less.
        max_iterations: of the adjustment.
        max_strikes: a track whose position has not agreed so many times is left out: it may be on
            something that moves.
        max_waiting: frames that are kept until the camera has moved enough for the first points; of
            more, those after the first one are dropped, and get no pose.
        seed: of the random samples for the first two frames; OpenCV's PnP has one of its own.

    Raises:
        OptionError: a value is out of its range.
    """

    min_motion_px: float = 5.0
    min_first_motion_px: float = 15.0
    min_tracked: float = 0.7
    max_error_px: float = 2.0
    min_inliers: int = 20
    min_angle_deg: float = 1.0
    window: int = 10
    anchors: int = 5
    robust_scale_px: float = 0.5
    max_iterations: int = 10
    max_strikes: int = 2
    max_waiting: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("min_motion_px", "min_first_motion_px", "max_error_px", "min_angle_deg"),
                *("robust_scale_px", "max_iterations", "max_strikes"),
            ),
            not_negative=("seed",),
            fractions=("min_tracked",),
            between={
                "min_inliers": (6, np.inf),
                "window": (2, np.inf),
                "anchors": (2, np.inf),
                "max_waiting": (2, np.inf),
            },
        )


@dataclass(frozen=True, eq=False)
class _Placed:
    """A frame's pose, relative to a keyframe, with which it moves."""

    number: int
    keyframe: int
    rotation: np.ndarray
    translation: np.ndarray


class VisualOdometry:
    """Estimates the path of a camera, frame by frame.

    Its world is the camera of the first frame with a pose; its unit is the distance between the two
    frames that made the first points. What is kept of frames and keyframes that the adjustment no
    longer reaches are their poses: less than a kilobyte each.

    Args:
        camera: of all frames, without distortion.
        options: how.

    Attributes:
        lost: number of the frame from which on no pose could be found, or None. Poses of later
            frames are not estimated: their scale would be another.

    Raises:
        MissingExtraError: pycolmap is not installed.
    """

    @suggest_keywords
    def __init__(self, camera: Camera, options: OdometryOptions = OdometryOptions()) -> None:
        import_pycolmap("visual odometry")  # which the adjustment would say much later
        self.camera = camera
        self.options = options
        self.lost: int | None = None
        self._waiting: list[TrackedFrame] = []
        self._waited = 0
        self._keyframes: list[Keyframe] = []
        self._placed: list[_Placed] = []
        self._map = MapPoints()
        self._pose = np.eye(3), np.zeros(3)
        self._motion = np.eye(3), np.zeros(3)

    @suggest_keywords
    def update(self, frame: TrackedFrame) -> bool:
        """Estimate the pose of the next frame.

        Args:
            frame: of a `Tracker`.

        Returns:
            Whether it has one. The first frames get theirs when the camera has moved enough.
        """
        if self.lost is not None:
            return False
        if not self._keyframes:
            self._waiting.append(frame)
            del self._waiting[1 : -self.options.max_waiting + 1]
            self._waited += 1
            return self._begin()
        self._map.add(frame.tracks)
        if self._place(frame):
            self._forget(frame)
            return True
        self.lost = frame.number
        return False

    @property
    def points(self) -> np.ndarray:
        """(P, 3) float64 points of the map: those that the last keyframes see."""
        return self._map.xyz[self._map.known()]

    def trajectory(self) -> Trajectory:
        """Return all poses, as they are after the last adjustment."""
        rotations, centres = [], []
        for placed in self._placed:
            keyframe = self._keyframes[placed.keyframe]
            rotation = placed.rotation @ keyframe.rotation
            translation = placed.rotation @ keyframe.translation + placed.translation
            rotations.append(rotation.T)
            centres.append(-rotation.T @ translation)
        return Trajectory(
            np.array([placed.number for placed in self._placed], np.int64),
            np.array(rotations).reshape(-1, 3, 3),
            np.array(centres).reshape(-1, 3),
        )

    def _begin(self) -> bool:
        """Make the first points, where the last frame shows that the camera has moved enough."""
        options = self.options
        first, last = self._waiting[0], self._waiting[-1]
        rows0, rows1 = common_rows(first, last)
        if len(rows0) < options.min_inliers:
            if len(self._waiting) > 1:  # too much has changed: begin here
                self._waiting, self._waited = [last], 1
            return False
        xy0, xy1 = (
            np.asarray(frame.xy[rows], np.float64)
            for frame, rows in ((first, rows0), (last, rows1))
        )
        if np.median(np.linalg.norm(xy1 - xy0, axis=1)) < options.min_first_motion_px:
            return False
        both = Calibration(self.camera, self.camera)
        pose = estimate_relative_pose(xy0, xy1, both, options.max_error_px / 2, options.seed)
        if pose is None:
            return False
        found = triangulate(xy0, xy1, both, pose.rotation, pose.translation)
        good = (
            pose.inliers
            & found.cheirality
            & (found.triangulation_angle > np.radians(options.min_angle_deg))
        )
        if np.count_nonzero(good) < options.min_inliers:
            return False
        self._map.add(np.union1d(first.tracks, last.tracks))
        self._map.xyz[self._map.rows(first.tracks[rows0[good]])] = found.points[good]
        self._add_keyframe(first, np.eye(3), np.zeros(3))
        self._add_keyframe(last, pose.rotation, pose.translation)
        self._adjust()
        self._placed.append(_Placed(first.number, 0, np.eye(3), np.zeros(3)))
        for frame in self._waiting[1:-1]:
            placed = self._solve(frame, (np.eye(3), np.zeros(3)))
            if placed is not None:
                rotation, translation, _ = placed
                self._placed.append(_Placed(frame.number, 0, rotation, translation))
        self._placed.append(_Placed(last.number, 1, np.eye(3), np.zeros(3)))
        self._pose = self._keyframes[1].rotation, self._keyframes[1].translation
        share = 1 / (self._waited - 1)
        turn = cv2.Rodrigues(cv2.Rodrigues(self._pose[0])[0] * share)[0]
        self._motion = turn, self._pose[1] * share
        self._waiting = []
        return True

    def _place(self, frame: TrackedFrame) -> bool:
        """Estimate the pose of a frame by the points that it sees; make it a keyframe or not."""
        options = self.options
        turn, move = self._motion  # as from the frame before that to the one before
        guess = turn @ self._pose[0], turn @ self._pose[1] + move
        solved = self._solve(frame, guess)
        if solved is None:
            return False
        rotation, translation, outliers = solved
        rows = self._map.rows(frame.tracks)
        self._map.strikes[rows[outliers]] += 1
        self._map.xyz[rows[self._map.strikes[rows] >= options.max_strikes]] = np.nan
        turn = rotation @ self._pose[0].T
        self._motion = turn, translation - turn @ self._pose[1]
        self._pose = rotation, translation
        last = self._keyframes[-1]
        rows0, rows1 = np.intersect1d(
            last.tracks, frame.tracks, assume_unique=True, return_indices=True
        )[1:]
        motion = np.linalg.norm(last.xy[rows0] - frame.xy[rows1], axis=1)
        known = np.isfinite(self._map.at(last.tracks)).all(axis=1)
        kept = np.count_nonzero(known[rows0]) / max(1, int(np.count_nonzero(known)))
        if kept >= options.min_tracked and np.median(motion) < options.min_motion_px:
            turn = rotation @ last.rotation.T
            relative = turn, translation - turn @ last.translation
            self._placed.append(_Placed(frame.number, len(self._keyframes) - 1, *relative))
            return True
        self._add_keyframe(frame, rotation, translation)
        self._placed.append(_Placed(frame.number, len(self._keyframes) - 1, np.eye(3), np.zeros(3)))
        self._triangulate()
        self._adjust()
        self._pose = self._keyframes[-1].rotation, self._keyframes[-1].translation
        return True

    def _solve(
        self, frame: TrackedFrame, guess: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return a frame's pose and the rows of its tracks that do not agree, or None."""
        options = self.options
        points = self._map.at(frame.tracks)
        rows = np.flatnonzero(np.isfinite(points).all(axis=1))
        if len(rows) < options.min_inliers:
            return None
        points = points[rows]
        xy = np.asarray(frame.xy[rows], np.float64)
        done, turn, move, inliers = cv2.solvePnPRansac(
            points,
            xy,
            self.camera.matrix,
            None,
            rvec=cv2.Rodrigues(guess[0])[0],
            tvec=guess[1].reshape(3, 1).copy(),
            useExtrinsicGuess=True,
            iterationsCount=PNP_ITERATIONS,
            reprojectionError=options.max_error_px,
            confidence=PNP_CONFIDENCE,
        )
        if not done or inliers is None or len(inliers) < options.min_inliers:
            return None
        agreeing = np.zeros(len(rows), bool)
        agreeing[inliers.ravel()] = True
        for _ in range(3):
            turn, move = cv2.solvePnPRefineLM(
                points[agreeing], xy[agreeing], self.camera.matrix, None, turn, move
            )
            rotation, translation = cv2.Rodrigues(turn)[0], move.ravel()
            seen = points @ rotation.T + translation
            errors = np.linalg.norm(self.camera.project(seen) - xy, axis=1)
            agreeing = (errors < options.max_error_px) & (seen[:, 2] > 0)
            if np.count_nonzero(agreeing) < options.min_inliers:
                return None
        return rotation, translation, rows[~agreeing]

    def _add_keyframe(
        self, frame: TrackedFrame, rotation: np.ndarray, translation: np.ndarray
    ) -> None:
        keyframe = Keyframe(
            frame.number,
            frame.tracks,
            np.asarray(frame.xy, np.float64),
            np.ones(len(frame), bool),
            rotation,
            translation,
        )
        self._keyframes.append(keyframe)
        self._check(keyframe)

    def _check(self, keyframe: Keyframe) -> None:
        """Trust the observations that agree with their points, and those without points."""
        points = self._map.at(keyframe.tracks)
        errors = keyframe.reprojection_errors(self.camera, points)
        unknown = ~np.isfinite(points).all(axis=1)
        keyframe.used = unknown | (errors < self.options.max_error_px)

    def _triangulate(self) -> None:
        """Add points for the tracks of the last keyframe, from the keyframe where they began."""
        options = self.options
        last = self._keyframes[-1]
        rows = self._map.rows(last.tracks)
        unknown = ~self._map.known()[rows]
        left = last.tracks[unknown & (self._map.strikes[rows] < options.max_strikes)]
        both = Calibration(self.camera, self.camera)
        for keyframe in self._keyframes[-options.window : -1]:
            tracks, rows0 = np.intersect1d(
                keyframe.tracks, left, assume_unique=True, return_indices=True
            )[:2]
            if not len(tracks):
                continue
            rows1 = np.searchsorted(last.tracks, tracks)
            turn = last.rotation @ keyframe.rotation.T
            move = last.translation - turn @ keyframe.translation
            found = triangulate(keyframe.xy[rows0], last.xy[rows1], both, turn, move)
            good = (
                found.cheirality
                & (found.triangulation_angle > np.radians(options.min_angle_deg))
                & (found.reprojection_errors < options.max_error_px / 2)
            )
            points = (found.points[good] - keyframe.translation) @ keyframe.rotation
            self._map.xyz[self._map.rows(tracks[good])] = points
            left = np.setdiff1d(left, tracks)
        for keyframe in self._keyframes[-options.window :]:
            self._check(keyframe)

    def _adjust(self) -> None:
        """Adjust the last keyframes, and leave out what does not agree afterwards."""
        options = self.options
        window = self._keyframes[-options.window - options.anchors :]
        free = min(options.window, len(self._keyframes) - 1)
        fixed = len(window) - free
        first = window[:2]
        scale = _distance(*first)
        adjust_keyframes(
            self.camera,
            window,
            self._map,
            fixed,
            options.robust_scale_px,
            options.max_iterations,
        )
        if fixed == 1:  # a single fixed camera leaves the scale free
            self._rescale(window, scale / _distance(*first))
        for keyframe in window:
            self._check(keyframe)
        seen = np.zeros(len(self._map.tracks), np.int64)
        for keyframe in window:
            seen[self._map.rows(keyframe.tracks[keyframe.used])] += 1
        recent = self._map.rows(np.unique(np.concatenate([each.tracks for each in window])))
        self._map.xyz[recent[seen[recent] < 2]] = np.nan

    def _forget(self, frame: TrackedFrame) -> None:
        """Let go of what neither the last keyframes see nor the last frame."""
        reach = self.options.window + self.options.anchors
        for keyframe in self._keyframes[-reach - 1 : -reach]:
            keyframe.forget_observations()
        seen = [frame.tracks, *(keyframe.tracks for keyframe in self._keyframes[-reach:])]
        self._map.keep(np.unique(np.concatenate(seen)))

    def _rescale(self, keyframes: list[Keyframe], factor: float) -> None:
        """Give all keyframes and points another scale; the first keyframe is the origin."""
        for keyframe in keyframes:
            keyframe.translation = keyframe.translation * factor
        self._map.xyz *= factor


def _distance(first: Keyframe, second: Keyframe) -> float:
    """Return the distance between two cameras."""
    return float(np.linalg.norm(second.centre - first.centre))
