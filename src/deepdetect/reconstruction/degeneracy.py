"""Why two images give no depth, said in one sentence before any cloud is made.

Each check takes matches, raises `ReconstructionError` when its reason holds, and is silent on good
pairs. They are meant to be run in the order of this module: `check_images`, then `check_matches`,
and with a pose `check_pose`; for rectified pairs `check_disparities`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..errors import ReconstructionError
from ..geometry import GeometryOptions, epipolar_errors, estimate_geometry, transfer_errors
from ..geometry.model_choice import has_depth
from ..guidance.trust import LARGEST, false_alarms
from .calibration import Calibration
from .relative_pose import RelativePose

FEWEST = 30
"""Matches, one a cell, below which nothing is tried."""

CELL = 16
"""Side in pixels of the cells of the first image that give one match each to the tests: matches
side by side are no independent evidence."""

THRESHOLD = 1.5
"""Pixels within which a match agrees with a fundamental matrix or a homography here."""

STILL = 0.5
"""Pixels: where nearly all matches move less, both images show the same view."""

NEARLY_ALL = 0.95

SAME = 0.5
"""Grey levels of mean difference under which two images are the same picture, stored anew."""

CALIBRATED = 0.75
"""Of the matches that agree with a fundamental matrix, the share that must agree with the
essential matrix: a right calibration explains as much."""

IN_FRONT = 0.75
"""Share of the inliers of a pose that must lie before both cameras."""

LEAST_SPREAD = 0.5
"""Pixels between the 5th and 95th percentile of the disparities of a scene with depth."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the matches of a sound pair have shown, for the checks that follow.

    Attributes:
        rows: (K,) rows of the matches that were looked at, one a cell.
        fundamental: (3, 3) that explains them best.
        explained: (K,) bool, which of them it explains.
        by_homography: share of them that one homography explains.
        log_false_alarms: decimal logarithm of the fundamental matrix's number of false alarms.
    """

    rows: np.ndarray
    fundamental: np.ndarray
    explained: np.ndarray
    by_homography: float
    log_false_alarms: float


def check_images(gray0: np.ndarray, gray1: np.ndarray) -> None:
    """Refuse two copies of one picture, also when one was stored anew.

    Args:
        gray0, gray1: (H, W) uint8 luma.

    Raises:
        ReconstructionError: they are the same.

    Example:
        >>> check_images(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8))
        Traceback (most recent call last):
        ...
        deepdetect.errors.ReconstructionError: both images are the same picture: depth needs two \
photographs from two places
    """
    if gray0.shape == gray1.shape and cv2.absdiff(gray0, gray1).mean() < SAME:
        raise ReconstructionError(
            "both images are the same picture: depth needs two photographs from two places"
        )


def check_matches(
    points0: np.ndarray,
    points1: np.ndarray,
    size1: tuple[int, int],
    calibration: Calibration | None = None,
    seed: int = 0,
) -> Evidence:
    """Refuse matches that show no overlap, no movement, or no depth.

    Args:
        points0, points1: (M, 2) matched positions in pixels.
        size1: (width, height) of the second image.
        calibration: tells a turning camera from a plane, where it is known.
        seed: of the random samples.

    Returns:
        What `check_pose` compares with.

    Raises:
        ReconstructionError: too few matches agree with one geometry; nothing moves; or one
            homography explains them all.
    """
    points0 = np.asarray(points0, np.float64).reshape(-1, 2)
    points1 = np.asarray(points1, np.float64).reshape(-1, 2)
    rows = one_a_cell(points0, seed)
    first, second = points0[rows], points1[rows]
    space, plane = (
        estimate_geometry(
            *(first, second), GeometryOptions(model=model, inlier_threshold=THRESHOLD, seed=seed)
        )
        for model in ("fundamental", "homography")
    )
    if len(rows) < FEWEST or space.matrix is None:
        raise ReconstructionError(_no_overlap(len(points0)))
    alarms = [
        false_alarms(errors, model, THRESHOLD, size1)
        for model, errors in (
            ("fundamental", epipolar_errors(first, second, space.matrix)),
            ("homography", _plane_errors(first, second, plane.matrix)),
        )
    ]
    if min(alarms) > LARGEST:
        raise ReconstructionError(_no_overlap(len(points0)))
    moved = np.linalg.norm(second - first, axis=1)[space.inliers | plane.inliers]
    if np.quantile(moved, NEARLY_ALL) < STILL:
        raise ReconstructionError(
            "nothing moves between the images: they show the same view, depth needs two "
            "photographs from two places"
        )
    if not has_depth(plane.inliers, space.inliers):
        raise ReconstructionError(_no_depth(first, second, plane.inliers, calibration))
    return Evidence(
        rows, space.matrix, space.inliers, float(plane.inliers.mean()), float(alarms[0])
    )


def check_pose(pose: RelativePose | None, evidence: Evidence, calibration: Calibration) -> None:
    """Refuse a pose that explains far less than is possible: the calibration is wrong.

    A wrong focal length is not seen where the camera only moved sideways: any fits there, and
    gives a scene that is stretched.

    Args:
        pose: of the same matches as the evidence; None when none could be estimated.
        evidence: of `check_matches`.
        calibration: that gave the pose.

    Raises:
        ReconstructionError: too few matches agree with the pose, or too many points lie behind.
    """
    advice = (
        f"the focal length of {calibration.camera0.focal_px[0]:.0f} px ({calibration.source}) is "
        "probably wrong for these images"
    )
    if pose is None:
        raise ReconstructionError(f"no pose of the cameras fits the matches: {advice}")
    possible = np.count_nonzero(evidence.explained)
    explained = np.count_nonzero(pose.errors[evidence.rows] < THRESHOLD)
    if explained < CALIBRATED * possible:
        raise ReconstructionError(
            f"with this calibration only {explained:,} of {possible:,} matches fit one pose of "
            f"the cameras: {advice}"
        )
    if pose.in_front < IN_FRONT:
        raise ReconstructionError(
            f"only {pose.in_front:.0%} of the points would lie before both cameras: {advice}"
        )


def check_disparities(disparity: np.ndarray) -> None:
    """Refuse disparities of a rectified pair that are all one value.

    Args:
        disparity: (N,) in pixels; those that are not finite do not count.

    Raises:
        ReconstructionError: there are none, or they do not differ.

    Example:
        >>> check_disparities(np.full(100, 7.0))
        Traceback (most recent call last):
        ...
        deepdetect.errors.ReconstructionError: all disparities are 7 px: one image is the other \
moved sideways, or both show one plane, and there is no depth
    """
    known = np.asarray(disparity)[np.isfinite(disparity)]
    if not len(known):
        raise ReconstructionError("no disparity was found: the images do not overlap")
    low, middle, high = np.quantile(known, [1 - NEARLY_ALL, 0.5, NEARLY_ALL])
    if high - low >= LEAST_SPREAD:
        return
    if abs(middle) < STILL:
        raise ReconstructionError(
            "all disparities are 0: both images were taken from one place, without a baseline"
        )
    raise ReconstructionError(
        f"all disparities are {middle:.3g} px: one image is the other moved sideways, or both "
        "show one plane, and there is no depth"
    )


def one_a_cell(points0: np.ndarray, seed: int = 0, cell: int = CELL) -> np.ndarray:
    """Choose a random match of each cell of the first image, (K,) rows in rising order.

    Args:
        points0: (M, 2) positions in the first image.
        seed: of the choice.
        cell: side of the cells in pixels.

    Example:
        >>> len(one_a_cell(np.array([[0, 0], [5, 5], [40, 5]])))
        2
    """
    place = np.floor(np.asarray(points0, np.float64) / cell).astype(np.int64)
    order = np.random.default_rng(seed).permutation(len(place))
    _, first = np.unique(place[order], axis=0, return_index=True)
    return np.sort(order[first])


def _plane_errors(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray | None
) -> np.ndarray:
    if homography is None:
        return np.full(len(points0), np.inf)
    return transfer_errors(points0, points1, homography)


def _no_overlap(matches: int) -> str:
    return (
        f"too few of the {matches:,} matches agree with one geometry: the photographs do not "
        "overlap, or do not show the same scene"
    )


def _no_depth(
    points0: np.ndarray, points1: np.ndarray, inliers: np.ndarray, calibration: Calibration | None
) -> str:
    if calibration is not None and _only_turned(points0[inliers], points1[inliers], calibration):
        return (
            "the camera only turned between the photographs and there is no depth: move it "
            "sideways"
        )
    return (
        "one homography explains all the matches: the photographs show a plane, or the camera "
        "only turned, and there is no depth"
    )


def _only_turned(points0: np.ndarray, points1: np.ndarray, calibration: Calibration) -> bool:
    """Tell whether one rotation takes the matches' rays onto each other, by Kabsch's method."""
    rays0, rays1 = (
        rays / np.linalg.norm(rays, axis=1, keepdims=True)
        for rays in (calibration.camera0.rays(points0), calibration.camera1.rays(points1))
    )
    u, _, vt = np.linalg.svd(rays1.T @ rays0)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    seen = calibration.camera1.project(rays0 @ rotation.T)
    return bool(np.median(np.linalg.norm(seen - points1, axis=1)) < THRESHOLD)
