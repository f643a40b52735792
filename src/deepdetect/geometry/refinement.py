"""Refine the fundamental matrix of two ordinary cameras whose focal length is not known.

Most pairs have square pixels, principal points near the middle, and similar focal lengths. Pose and
cameras are fitted together to matches and to this prior.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .camera import Calibration, Camera, Size, fundamental_matrix
from .relative_pose import best_of_four, fit_to_lines, moved_pose
from .similarity import MAD_STD
from .transforms import epipolar_errors

MIN_MATCHES = 6
"""Five matches determine a pose; only from a sixth on do they constrain the cameras."""

START_FOCAL_LENGTHS = np.geomspace(0.4, 2.5, 12)
"""Focal lengths in units of the image's longer side. The refinement starts from the one that brings
the fundamental matrix closest to an essential matrix. Chosen by hand."""

FOCAL_SPREAD, FOCAL_DIFFERENCE, PRINCIPAL_POINT_SPREAD = 0.7, 0.03, 0.03
"""Prior standard deviations, in units of the image's longer side: of the mean log focal length from
0, of the difference of both log focal lengths, and of cx and cy from the middle. Chosen by hand."""

MIN_SIGMA_PX = 0.1
"""Minimum standard deviation of match errors in `refine_fundamental`. Chosen by hand."""


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
    start = _calibration(cameras, sizes)
    pose = best_of_four(_essential(fundamental, start), points0, points1, start)
    of_matches = np.repeat(sigmas, [len(each[0]) for each in sources])
    pose, cameras = fit_to_lines(
        (pose, cameras),
        points0,
        points1,
        of_matches,
        lambda views: fundamental_matrix(_calibration(views[1], sizes), *views[0]),
        lambda views, change: (moved_pose(views[0], change[:5]), views[1] + change[5:]),
        np.eye(11),
        prior=lambda views: _deviations(views[1]),
    )
    matrix = fundamental_matrix(_calibration(cameras, sizes), *pose)
    return np.asarray(matrix / np.linalg.norm(matrix))


def _nearest_cameras(fundamental: np.ndarray, sizes: tuple[Size, Size]) -> np.ndarray:
    """Return the cameras whose focal length brings `fundamental` closest to an essential matrix."""

    def likeness(cameras: np.ndarray) -> float:
        essential = _essential(fundamental, _calibration(cameras, sizes))
        largest, middle, _ = np.linalg.svd(essential, compute_uv=False)
        return float(middle / largest)

    guesses = (np.array([math.log(focal)] * 2 + [0.0] * 4) for focal in START_FOCAL_LENGTHS)
    return max(guesses, key=likeness)


def _calibration(cameras: np.ndarray, sizes: tuple[Size, Size]) -> Calibration:
    """Return the two cameras of six parameters in units of the longer side of each image.

    These are the natural logarithms of both focal lengths, and x and y of both principal points
    minus the image centres.
    """
    made = []
    for size, log_focal, offset in zip(sizes, cameras[:2], cameras[2:].reshape(2, 2), strict=True):
        centre = (np.array(size) - 1) / 2 + offset * max(size)
        made.append(Camera(size, math.exp(log_focal) * max(size), tuple(centre)))
    return Calibration(made[0], made[1])


def _essential(fundamental: np.ndarray, calibration: Calibration) -> np.ndarray:
    return calibration.camera1.matrix.T @ fundamental @ calibration.camera0.matrix


def _deviations(cameras: np.ndarray) -> np.ndarray:
    """Return the (6,) deviations from the prior, each in units of its standard deviation."""
    mean, difference = cameras[:2].mean(), cameras[0] - cameras[1]
    of_focal = [mean / FOCAL_SPREAD, difference / FOCAL_DIFFERENCE]
    return np.append(of_focal, cameras[2:] / PRINCIPAL_POINT_SPREAD)
