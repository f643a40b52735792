"""Refine the fundamental matrix of two ordinary cameras whose focal length is not known.

Most pairs have square pixels, principal points near the middle, and similar focal lengths. Pose and
cameras are fitted together to matches and to this prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .camera import Calibration, Camera, Size, cross_matrix
from .relative_pose import Pose, best_of_four, moved_pose
from .similarity import MAD_STD
from .transforms import epipolar_errors, signed_epipolar_errors

MIN_MATCHES = 6
"""Five matches determine a pose; only from a sixth on do they constrain the cameras."""

START_FOCAL_LENGTHS = np.geomspace(0.4, 2.5, 12)
"""Focal lengths in units of the image's longer side. The refinement starts from the one that makes
the matrix most nearly essential. Chosen by hand."""

FOCAL_SPREAD, FOCAL_DIFFERENCE, PRINCIPAL_POINT_SPREAD = 0.7, 0.03, 0.03
"""Prior standard deviations, in units of the image's longer side: of the mean log focal length from
0, of the difference of both log focal lengths, and of cx and cy from the middle. Chosen by hand."""

MIN_SIGMA_PX = 0.1
"""Minimum standard deviation of match errors in `refine_fundamental`. Chosen by hand."""

MAX_ITERATIONS = 20
"""Maximum number of steps of Levenberg-Marquardt. Chosen by hand."""


def refine_fundamental(
    sources: Sequence[tuple[np.ndarray, np.ndarray]],
    fundamental: np.ndarray,
    sizes: tuple[Size, Size],
) -> np.ndarray:
    """Refine a fundamental matrix by mostly correct matches and a prior on the two cameras.

    `sources` are sets of matches: (M, 2) positions in both images, weighted by their median error.
    The result has norm 1. With fewer than six matches, `fundamental` is returned as it is.
    """
    points0, points1 = (np.concatenate([each[side] for each in sources]) for side in (0, 1))
    if len(points0) < MIN_MATCHES:
        return fundamental
    medians = [np.median(epipolar_errors(*each, fundamental)) for each in sources]
    sigmas = np.maximum(MAD_STD * np.array(medians), MIN_SIGMA_PX)
    cameras = _nearest_cameras(fundamental, sizes)
    essential = cameras.essential(fundamental)
    views = best_of_four(essential, points0, points1, cameras.calibration), cameras
    of_matches = np.repeat(sigmas, [len(each[0]) for each in sources])
    matrix = _fundamental(*_fit(views, points0, points1, of_matches))
    return np.asarray(matrix / np.linalg.norm(matrix))


def _nearest_cameras(fundamental: np.ndarray, sizes: tuple[Size, Size]) -> _Cameras:
    """Return the cameras whose focal length makes the matrix most nearly an essential matrix."""

    def likeness(cameras: _Cameras) -> float:
        largest, middle, _ = np.linalg.svd(cameras.essential(fundamental), compute_uv=False)
        return float(middle / largest)

    return max((_Cameras.guess(sizes, focal) for focal in START_FOCAL_LENGTHS), key=likeness)


@dataclass(frozen=True, eq=False)
class _Cameras:
    """The two cameras, as six parameters in units of the longer side of each image.

    `log_focal` (2,) are natural logarithms of the focal lengths, and `offsets` (2, 2) the principal
    points minus the image centres.
    """

    sizes: tuple[Size, Size]
    log_focal: np.ndarray
    offsets: np.ndarray

    @classmethod
    def guess(cls, sizes: tuple[Size, Size], focal: float) -> _Cameras:
        return cls(sizes, np.full(2, math.log(focal)), np.zeros((2, 2)))

    @property
    def calibration(self) -> Calibration:
        cameras = []
        for size, log_focal, offset in zip(self.sizes, self.log_focal, self.offsets, strict=True):
            side = max(size)
            centre = (np.array(size) - 1) / 2 + offset * side
            cameras.append(Camera(size, math.exp(log_focal) * side, tuple(centre)))
        return Calibration(cameras[0], cameras[1])

    @cached_property
    def inverses(self) -> tuple[np.ndarray, np.ndarray]:
        calibration = self.calibration
        return np.linalg.inv(calibration.camera0.matrix), np.linalg.inv(calibration.camera1.matrix)

    def fundamental(self, essential: np.ndarray) -> np.ndarray:
        inverse0, inverse1 = self.inverses
        return np.asarray(inverse1.T @ essential @ inverse0)

    def essential(self, fundamental: np.ndarray) -> np.ndarray:
        calibration = self.calibration
        return calibration.camera1.matrix.T @ fundamental @ calibration.camera0.matrix

    def moved(self, change: np.ndarray) -> _Cameras:
        if not change.any():  # keeps the cached inverses
            return self
        offsets = self.offsets + change[2:].reshape(2, 2)
        return _Cameras(self.sizes, self.log_focal + change[:2], offsets)

    def deviations(self) -> np.ndarray:
        """Return the (6,) deviations from the prior, each in units of its standard deviation."""
        mean, difference = self.log_focal.mean(), self.log_focal[0] - self.log_focal[1]
        of_focal = [mean / FOCAL_SPREAD, difference / FOCAL_DIFFERENCE]
        return np.append(of_focal, self.offsets / PRINCIPAL_POINT_SPREAD)


Views = tuple[Pose, _Cameras]
"""A relative pose and the two cameras: 5 + 6 parameters."""


def _fundamental(pose: Pose, cameras: _Cameras) -> np.ndarray:
    rotation, translation = pose
    return cameras.fundamental(cross_matrix(translation) @ rotation)


def _moved(views: Views, change: np.ndarray) -> Views:
    pose, cameras = views
    return moved_pose(pose, change[:5]), cameras.moved(change[5:])


def _fit(views: Views, points0: np.ndarray, points1: np.ndarray, sigmas: np.ndarray) -> Views:
    """Fit pose and cameras to matches with a Cauchy loss, and to the prior (a MAP estimate)."""
    count = len(points0)

    def residuals(views: Views) -> np.ndarray:
        errors = signed_epipolar_errors(points0, points1, _fundamental(*views))
        return np.append(errors / sigmas, views[1].deviations())

    def cost(errors: np.ndarray) -> float:
        matches, usual = errors[:count], errors[count:]
        return float(2 * np.log1p((matches / 2) ** 2).sum() + (usual**2).sum() / 2)

    step, damping = 1e-6, 1e-3
    errors = residuals(views)
    lowest = cost(errors)
    for _ in range(MAX_ITERATIONS):
        varied = (residuals(_moved(views, axis)) for axis in np.eye(11) * step)
        slopes = np.column_stack([(other - errors) / step for other in varied])
        weights = np.ones(len(errors))
        weights[:count] = 1 / (1 + (errors[:count] / 2) ** 2)
        normal, gradient = slopes.T @ (slopes * weights[:, None]), slopes.T @ (weights * errors)
        before = lowest
        while damping < 1e6:
            damped = normal + np.diag(damping * np.diag(normal) + 1e-12)
            moved = _moved(views, -np.linalg.solve(damped, gradient))
            moved_errors = residuals(moved)
            if cost(moved_errors) < lowest:
                views, errors, lowest = moved, moved_errors, cost(moved_errors)
                damping /= 5
                break
            damping *= 5
        if before - lowest < 1e-4:
            break
    return views
