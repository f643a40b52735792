"""Points from the matches of two calibrated images that need not be rectified.

Sub-pixel matches -> relative pose -> triangulation -> checks -> points.

Matches on whole pixels are all refined. Those of rectified rows are sub-pixel already, and more
accurate along their epipolar lines than a small patch alone can say; but across them they are as
the fundamental matrix that rectified the pair, and know no more of the pose. So the pose is that of
a sample of corners, each refined by itself, and the points are those of the matches as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.errors import ReconstructionError
from .._shared.timing import StageTimer
from ..geometry import epipolar_errors
from ..geometry.camera import Calibration
from ..geometry.relative_pose import RelativePose, estimate_relative_pose
from ..geometry.triangulation import fundamental_matrix, triangulate
from .checks import check_focal, check_matches, check_pose
from .outliers import PointFilterOptions, disparity_space, sor_inliers
from .subpixel import refine_matches, spread_corners

MAX_EPIPOLAR_DISTANCE_PX = 1.0
"""Within which a match agrees with the pose (Sampson's distance)."""

MAX_REPROJECTION_ERROR_PX = 0.5
"""Of a point that is kept (root mean square of both images)."""

POSE_CELLS = 10_000
"""Of matches that are sub-pixel already, the best corner of each of this many cells is refined, for
the pose."""


@dataclass(frozen=True, eq=False)
class TwoViewReconstruction:
    """Triangulated points of a pair.

    Attributes:
        points: (N, 3) float32 in the frame of the left camera: x right, y down, z forward.
        indices: (N,) int64, the match that each comes from, rising.
        points1: (N, 2) float64 positions in the right image that the points were made from.
        pose: of the right camera; its inliers and errors belong to `pose_indices`.
        pose_indices: (P,) int64, the matches that the pose was estimated from: those that were
            refined; or all.
        reprojection_errors: (N,) float32 in pixels, root mean square of both images.
        dropped: how many matches each check removed, in order.
    """

    points: np.ndarray
    indices: np.ndarray
    points1: np.ndarray
    pose: RelativePose
    pose_indices: np.ndarray
    reprojection_errors: np.ndarray
    dropped: dict[str, int]


def reconstruct_two_view(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    images: tuple[np.ndarray, np.ndarray] | None = None,
    point_filter: PointFilterOptions = PointFilterOptions(),
    seed: int = 0,
    timer: StageTimer | None = None,
    refined: bool = False,
) -> TwoViewReconstruction:
    """Reconstruct the points of a pair.

    Args:
        points0, points1: (M, 2) matched positions in the left and the right image. To be refined,
            those of the left lie on whole pixels.
        calibration: of both cameras.
        images: (H, W) uint8 luma of both, for the refinement; None leaves that out.
        point_filter: which points are kept.
        seed: of all random choices.
        timer: of the stages; None: a new one.
        refined: whether the positions in the right image are sub-pixel already
            (`Matches.subpixel`): then some are refined for the pose only.

    Raises:
        ReconstructionError: the pair gives no depth (`checks` says why), or no point is left.

    Example:
        >>> from deepdetect.geometry.camera import Camera
        >>> camera = Camera((640, 480), 500.0)
        >>> grid = np.stack(np.meshgrid(np.arange(0, 640, 16), np.arange(0, 480, 16)), -1)
        >>> left = grid.reshape(-1, 2).astype(float)
        >>> depth = 5 + np.sin(left[:, 0] / 40) + np.cos(left[:, 1] / 50)
        >>> true = camera.rays(left) * depth[:, None]
        >>> right = camera.project(true - [1, 0.1, 0])
        >>> found = reconstruct_two_view(left, right, Calibration(camera, camera))
        >>> points = found.points * np.hypot(1, 0.1)
        >>> len(points) > 1000, bool(np.allclose(points, true[found.indices], rtol=1e-2))
        (True, True)
    """
    timer = StageTimer() if timer is None else timer
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    indices = pose_indices = np.arange(len(points0))
    pose_points1 = points1
    dropped: dict[str, int] = {}
    if images is not None:
        with timer.stage("sub-pixel"):
            if refined:
                pose_indices = spread_corners(images[0], points0, POSE_CELLS)
            aligned = refine_matches(*images, points0[pose_indices], points1[pose_indices])
        pose_indices = pose_indices[aligned.converged]
        pose_points1 = aligned.points1[aligned.converged]
        if not refined:
            indices, points1 = pose_indices, aligned.points1
            dropped["not refined"] = len(points0) - len(indices)
    evident = points0[pose_indices], pose_points1
    with timer.stage("checks"):
        cells, scene = check_matches(*evident, calibration.camera1.size, calibration, seed)
    with timer.stage("pose"):
        found = estimate_relative_pose(*evident, calibration, MAX_EPIPOLAR_DISTANCE_PX, seed)
        pose = check_pose(found, cells, scene, calibration)
    with timer.stage("focal length"):
        explained = cells[scene.epipolar.inliers]
        on_lines = evident[0][explained], evident[1][explained]
        check_focal(*on_lines, pose.errors[explained], calibration, seed)
    baseline = 1.0 if calibration.baseline_mm is None else calibration.baseline_mm
    used = points0[indices], points1[indices]
    with timer.stage("triangulation"):
        made = triangulate(*used, calibration, pose.rotation, pose.translation * baseline)
    fundamental = fundamental_matrix(calibration, pose.rotation, pose.translation)
    near_line = epipolar_errors(*used, fundamental) < MAX_EPIPOLAR_DISTANCE_PX
    focal = calibration.camera0.focal_px[0]
    kept = np.ones(len(indices), bool)
    for reason, passed in (
        ("far from its epipolar line", near_line),
        ("behind a camera", made.cheirality),
        ("reprojection error", made.reprojection_errors < MAX_REPROJECTION_ERROR_PX),
        ("parallax", made.triangulation_angle * focal >= point_filter.min_parallax_px),
    ):
        dropped[reason] = int(np.count_nonzero(kept & ~passed))
        kept &= passed
    if point_filter.sor_neighbors:
        with timer.stage("outlier removal"):
            space = disparity_space(made.points[kept], focal, baseline)
            inliers = sor_inliers(space, point_filter)
        dropped["statistical outlier"] = int(np.count_nonzero(~inliers))
        kept[kept] = inliers
    if not kept.any():
        counts = ", ".join(f"{reason}: {count:,}" for reason, count in dropped.items() if count)
        raise ReconstructionError(
            f"none of the {len(points0):,} matches gives a point ({counts}): take "
            "images that overlap more, or check the calibration"
        )
    return TwoViewReconstruction(
        points=made.points[kept].astype(np.float32),
        indices=indices[kept],
        points1=points1[indices[kept]],
        pose=pose,
        pose_indices=pose_indices,
        reprojection_errors=made.reprojection_errors[kept].astype(np.float32),
        dropped=dropped,
    )
