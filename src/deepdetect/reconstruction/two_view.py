"""Points in space from the matches of two calibrated images that need not be rectified.

Sub-pixel matches -> relative pose -> triangulation -> checks -> points.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from .._shared.errors import OptionError, ReconstructionError
from ..geometry.camera import Calibration
from ..geometry.relative_pose import RelativePose, estimate_relative_pose
from ..geometry.triangulation import triangulate
from .checks import check_focal, check_images, check_matches, check_pose
from .outliers import disparity_space, statistical_inliers
from .subpixel import SubpixelOptions, refine_matches


@dataclass(frozen=True)
class TwoViewOptions:
    """How matches become points.

    Attributes:
        inlier_threshold: a match agrees with the pose when it is nearer to it than this, in
            pixels (Sampson's distance).
        reprojection_threshold: a point stays when it is seen nearer than this to its match, in
            pixels (root mean square of both images).
        least_parallax_px: both rays of a point must differ by so many pixels' angle: less says
            nothing of the depth.
        neighbours, factor: of the statistical outlier removal; 0 neighbours leave it out.
        subpixel: how matches are refined, or None: they are taken as they are.
        seed: of all random choices.

    Raises:
        OptionError: a value is out of its range.
    """

    inlier_threshold: float = 1.0
    reprojection_threshold: float = 0.5
    least_parallax_px: float = 2.0
    neighbours: int = 16
    factor: float = 2.0
    subpixel: SubpixelOptions | None = field(default_factory=SubpixelOptions)
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("inlier_threshold", "reprojection_threshold"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be above 0 pixels, not {getattr(self, name)}")
        for name in ("least_parallax_px", "neighbours", "factor"):
            if not getattr(self, name) >= 0:
                raise OptionError(f"{name} must not be negative, but is {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise OptionError(f"the seed must lie in [0, 2147483647], not {self.seed}")


@dataclass(frozen=True, eq=False)
class TwoViewReconstruction:
    """Points in space.

    Attributes:
        points: (N, 3) float32 in the frame of the left camera: x right, y down, z forward.
        unit: "mm" when the baseline is known, else "baseline": the distance of the cameras is 1.
        rows: (N,) int64, the match that each comes from, rising.
        points1: (N, 2) float64 its place in the right image, refined.
        pose: of the right camera; its inliers and errors belong to `posed`.
        posed: (P,) int64, the matches that the pose was estimated from: those that were refined.
        reprojection_errors: (N,) float32 in pixels, root mean square of both images.
        parallax: (N,) float32 angle between both rays in degrees.
        dropped: how many matches each check took away, in order.
        seconds: time of each stage.
    """

    points: np.ndarray
    unit: str
    rows: np.ndarray
    points1: np.ndarray
    pose: RelativePose
    posed: np.ndarray
    reprojection_errors: np.ndarray
    parallax: np.ndarray
    dropped: dict[str, int]
    seconds: dict[str, float]

    def __len__(self) -> int:
        return len(self.points)


def reconstruct_two_view(
    points0: np.ndarray,
    points1: np.ndarray,
    calibration: Calibration,
    images: tuple[np.ndarray, np.ndarray] | None = None,
    options: TwoViewOptions = TwoViewOptions(),
) -> TwoViewReconstruction:
    """Reconstruct the points of a pair.

    Args:
        points0, points1: (M, 2) matched positions in the left and the right image. To be refined,
            those of the left lie on whole pixels.
        calibration: of both cameras.
        images: (H, W) uint8 luma of both, for the refinement; None leaves it out.
        options: of all stages.

    Raises:
        ReconstructionError: the pair gives no depth (`degeneracy` says why), the calibration is
            for images of another size, or no point is left.

    Example:
        >>> from .calibration import Camera
        >>> camera = Camera((640, 480), 500.0)
        >>> grid = np.stack(np.meshgrid(np.arange(0, 640, 16), np.arange(0, 480, 16)), -1)
        >>> left = grid.reshape(-1, 2).astype(float)
        >>> depth = 5 + np.sin(left[:, 0] / 40) + np.cos(left[:, 1] / 50)
        >>> space = camera.rays(left) * depth[:, None]
        >>> right = camera.project(space - [1, 0.1, 0])
        >>> found = reconstruct_two_view(left, right, Calibration(camera, camera))
        >>> scale = np.hypot(1, 0.1)
        >>> len(found) > 1000, bool(np.allclose(found.points * scale, space[found.rows], rtol=1e-2))
        (True, True)
    """
    seconds: dict[str, float] = {}
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    rows = np.arange(len(points0))
    dropped: dict[str, int] = {}
    if images is not None:
        calibration.check_sizes(*((image.shape[1], image.shape[0]) for image in images))
        check_images(*images)
        if options.subpixel is not None:
            with _timed(seconds, "sub-pixel"):
                refined = refine_matches(*images, points0, points1, options.subpixel)
            rows = np.flatnonzero(refined.converged)
            points1 = refined.points1
            dropped["not refined"] = len(points0) - len(rows)
    with _timed(seconds, "checks"):
        evidence = check_matches(
            points0[rows], points1[rows], calibration.camera1.size, calibration, options.seed
        )
    with _timed(seconds, "pose"):
        pose = estimate_relative_pose(
            points0[rows], points1[rows], calibration, options.inlier_threshold, options.seed
        )
        check_pose(pose, evidence, calibration)
    assert pose is not None
    with _timed(seconds, "focal length"):
        check_focal(points0[rows], points1[rows], pose, evidence, calibration, options.seed)
    posed = rows
    baseline = calibration.baseline_mm
    length = 1.0 if baseline is None else baseline
    with _timed(seconds, "triangulation"):
        found = triangulate(
            points0[rows], points1[rows], calibration, pose.rotation, pose.translation * length
        )
    focal = calibration.camera0.focal_px[0]
    kept = np.ones(len(rows), bool)
    for reason, passed in (
        ("far from its epipolar line", pose.inliers),
        ("behind a camera", found.cheirality),
        ("reprojection error", found.reprojection_errors < options.reprojection_threshold),
        ("parallax", found.triangulation_angle * focal >= options.least_parallax_px),
    ):
        dropped[reason] = int(np.count_nonzero(kept & ~passed))
        kept &= passed
    if options.neighbours:
        with _timed(seconds, "outlier removal"):
            space = disparity_space(found.points[kept], focal, length)
            alone = ~statistical_inliers(space, options.neighbours, options.factor)
        dropped["alone"] = int(alone.sum())
        kept[kept] = ~alone
    if not kept.any():
        raise ReconstructionError(
            f"none of the {len(points0):,} matches gives a point ({_counts(dropped)}): take "
            "photographs that overlap more, or check the calibration"
        )
    return TwoViewReconstruction(
        found.points[kept].astype(np.float32),
        "baseline" if baseline is None else "mm",
        rows[kept],
        points1[rows[kept]],
        pose,
        posed,
        found.reprojection_errors[kept].astype(np.float32),
        np.degrees(found.triangulation_angle[kept]).astype(np.float32),
        dropped,
        seconds,
    )


def _counts(dropped: dict[str, int]) -> str:
    return ", ".join(f"{reason}: {count:,}" for reason, count in dropped.items() if count)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - started
