"""Why two images give no depth, said in one sentence before any cloud is made.

Each check raises `ReconstructionError` when its reason holds, and is silent on good pairs. They are
meant to be run in the order of this module: `check_images`, `check_matches`, and with a pose
`check_pose` and `check_focal`; for rectified pairs `check_images`, then those of `row_degeneracy`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from .._shared.errors import ReconstructionError
from ..features.selection import grid_subsample
from ..geometry import GeometryOptions, epipolar_errors, estimate_geometry, transfer_errors
from ..geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from ..geometry.camera import Calibration, Camera
from ..geometry.model_selection import select_model
from ..geometry.relative_pose import RelativePose, estimate_relative_pose

FEWEST = 30
"""Matches, one a cell, below which nothing is tried."""

CELL = 16
"""Side in pixels of the cells of the first image that give one match each to the tests: matches
side by side are no independent evidence."""

THRESHOLD = 1.5
PLANE_THRESHOLD = 2.0
"""Pixels within which a match agrees with a fundamental matrix (Sampson's distance, one direction
of error) and with a homography (two directions)."""

FLAT = 0.75
"""A homography that explains less than this share of what the fundamental matrix does is no plane,
whatever the other matches are."""

CLEARLY = 3.0
OF_CLEAR = 0.8
FEW = 0.05
"""A scene has depth, too, when a share of at least 0.05 of what the fundamental matrix explains is
further from the plane than three thresholds, and is at least 0.8 of all that is so far off it: what
stands before a wall. On planes wrong matches are so far off, and fewer of them lie on the lines: up
to 0.65 of them on sixteen pairs of Oxford."""

STILL = 0.5
NOISE = 3.0
"""Pixels: where half of the matches move less than the one, and nearly all less than the other,
both images show the same view."""

NEARLY_ALL = 0.9

SAME = 0.5
NOWHERE = 8.0
OF_CONTRAST = 0.5
"""Two images are the same picture, stored anew, when they differ by fewer grey levels than the one
in the mean, and than the other nearly everywhere; and also nearly everywhere by less than this
share of what the picture differs from itself moved by a pixel: dark views differ by few levels."""

NEARLY_EVERYWHERE = 0.999

CALIBRATED = 0.75
"""Of the matches that agree with a fundamental matrix, the share that must agree with the
essential matrix: a right calibration explains as much."""

IN_FRONT = 0.75
"""Share of the inliers of a pose that must lie before both cameras."""

FOCAL_FACTORS = (0.25, 0.35, 0.5, 0.7, 1.4, 2.0, 2.8, 4.0)
BETTER = 0.5
"""Other focal lengths that are tried, in units of the given one, and by how much the median error
must shrink for one of them: a focal length that is a fifth off passes."""

GOOD = 0.1
"""Pixels of median error that no better focal length is looked for at."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the matches of a sound pair have shown, for the checks that follow.

    Attributes:
        rows: (K,) rows of the matches that were looked at, one a cell.
        fundamental: (3, 3) that explains them best.
        explained: (K,) bool, which of them it explains.
        by_homography: share of them that one homography explains.
        log10_nfa: decimal logarithm of the fundamental matrix's number of false alarms.
    """

    rows: np.ndarray
    fundamental: np.ndarray
    explained: np.ndarray
    by_homography: float
    log10_nfa: float


def check_images(gray0: np.ndarray, gray1: np.ndarray) -> None:
    """Refuse two copies of one picture, also when one was stored anew without visible loss.

    Copies that lost more show the same view: `check_matches` and `check_disparities` refuse them.

    Args:
        gray0, gray1: (H, W) uint8 luma.

    Raises:
        ReconstructionError: they are the same.

    Example:
        >>> check_images(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8))
        Traceback (most recent call last):
        ...
        deepdetect.ReconstructionError: both images are the same picture: depth needs two \
photographs from two places
    """
    if gray0.shape == gray1.shape and _same(gray0, gray1):
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
    rows = grid_subsample(points0, CELL, seed)
    first, second = points0[rows], points1[rows]
    space, plane = (
        estimate_geometry(
            *(first, second), GeometryOptions(model=model, inlier_threshold=threshold, seed=seed)
        )
        for model, threshold in (("fundamental", THRESHOLD), ("homography", PLANE_THRESHOLD))
    )
    if len(rows) < FEWEST or space.matrix is None:
        raise ReconstructionError(_no_overlap(len(points0)))
    alarms = [
        log10_nfa(errors, model, threshold, size1)
        for model, threshold, errors in (
            ("fundamental", THRESHOLD, epipolar_errors(first, second, space.matrix)),
            ("homography", PLANE_THRESHOLD, _plane_errors(first, second, plane.matrix)),
        )
    ]
    if min(alarms) > MAX_LOG10_NFA:
        raise ReconstructionError(_no_overlap(len(points0)))
    moved = np.linalg.norm(second - first, axis=1)[space.inliers | plane.inliers]
    if stands_still(moved):
        raise ReconstructionError(
            "nothing moves between the images: they show the same view, depth needs two "
            "photographs from two places"
        )
    off = _plane_errors(first, second, plane.matrix)
    if is_flat(plane.inliers, space.inliers) and not _stands_out(off, space.inliers):
        raise ReconstructionError(_no_depth(first, second, plane.inliers, calibration))
    return Evidence(
        rows, space.matrix, space.inliers, float(plane.inliers.mean()), float(alarms[0])
    )


def check_pose(pose: RelativePose | None, evidence: Evidence, calibration: Calibration) -> None:
    """Refuse a pose that explains far less than is possible: the calibration is wrong.

    Args:
        pose: of the same matches as the evidence; None when none could be estimated.
        evidence: of `check_matches`.
        calibration: that gave the pose.

    Raises:
        ReconstructionError: too few matches agree with the pose, or too many points lie behind.
    """
    if pose is None:
        raise ReconstructionError(f"no pose of the cameras fits the matches: {_wrong(calibration)}")
    possible = np.count_nonzero(evidence.explained)
    explained = np.count_nonzero(pose.errors[evidence.rows] < THRESHOLD)
    if explained < CALIBRATED * possible:
        raise ReconstructionError(
            f"with this calibration only {explained:,} of {possible:,} matches fit one pose of "
            f"the cameras: {_wrong(calibration)}"
        )
    if pose.cheirality_ratio < IN_FRONT:
        raise ReconstructionError(
            f"only {pose.cheirality_ratio:.0%} of the points would lie before both cameras: "
            f"{_wrong(calibration)}"
        )


def check_focal(
    points0: np.ndarray,
    points1: np.ndarray,
    pose: RelativePose,
    evidence: Evidence,
    calibration: Calibration,
    seed: int = 0,
) -> None:
    """Refuse a focal length when quite another one fits the matches far better.

    Where the camera only moved sideways every focal length fits as well, and a wrong one goes
    unseen: it gives a scene that is stretched in depth. One that is too long shows less than one
    that is too short.

    Args:
        points0, points1: (M, 2) the matches that the pose and the evidence come from.
        pose, evidence, calibration: as of `check_pose`.
        seed: of the random samples.

    Raises:
        ReconstructionError: another focal length halves the median error; it is named.
    """
    rows = evidence.rows[evidence.explained]
    given = float(np.median(pose.errors[rows]))
    if given < GOOD:
        return
    best, factor = BETTER * given, 1.0
    for other in FOCAL_FACTORS:
        scaled = replace(
            calibration,
            camera0=_with_focal(calibration.camera0, other),
            camera1=_with_focal(calibration.camera1, other),
        )
        found = estimate_relative_pose(points0[rows], points1[rows], scaled, THRESHOLD, seed)
        if found is None or found.cheirality_ratio < IN_FRONT:
            continue
        error = float(np.median(found.errors))
        if error < best:
            best, factor = error, other
    if factor != 1:
        focal = calibration.camera0.focal_px[0]
        raise ReconstructionError(
            f"{_wrong(calibration)}: one of about {focal * factor:.0f} px fits the matches "
            f"{given / best:.1f} times as well"
        )


def _same(gray0: np.ndarray, gray1: np.ndarray) -> bool:
    difference = cv2.absdiff(gray0, gray1)
    if difference.mean() >= SAME:
        return False
    largest = np.quantile(difference, NEARLY_EVERYWHERE)
    contrast = np.quantile(cv2.absdiff(gray0[:, 1:], gray0[:, :-1]), NEARLY_EVERYWHERE)
    return bool(largest <= min(NOWHERE, OF_CONTRAST * contrast))


def is_flat(by_homography: np.ndarray, by_fundamental: np.ndarray) -> bool:
    """Tell whether a homography explains all that can be explained, though many may be wrong.

    Args:
        by_homography, by_fundamental: (M,) bool, the matches that each explains.
    """
    nearly = np.count_nonzero(by_homography) >= FLAT * np.count_nonzero(by_fundamental)
    return bool(nearly and select_model(by_homography, by_fundamental) == "homography")


def stands_still(moved: np.ndarray) -> bool:
    """Tell from how far matches move, in pixels, whether both images show the same view.

    Example:
        >>> stands_still(np.array([0.1, 0.0, 0.3])), stands_still(np.array([0.1, 0.2, 7.0]))
        (True, False)
    """
    moved = np.abs(moved)
    return bool(np.median(moved) < STILL and np.quantile(moved, NEARLY_ALL) < NOISE)


def _wrong(calibration: Calibration) -> str:
    return (
        f"the focal length of {calibration.camera0.focal_px[0]:.0f} px ({calibration.source}) is "
        "probably wrong for these images"
    )


def _with_focal(camera: Camera, factor: float) -> Camera:
    fx, fy = camera.focal_px
    return replace(camera, focal_px=(fx * factor, fy * factor))


def _stands_out(off: np.ndarray, inliers: np.ndarray) -> bool:
    """Tell whether something stands before the plane, small as it may be.

    Args:
        off: (N,) pixels by which matches lie off the plane.
        inliers: (N,) bool, those that the fundamental matrix explains.
    """
    clear = off > CLEARLY * PLANE_THRESHOLD
    before = np.count_nonzero(clear & inliers)
    return before > 0 and before >= max(
        OF_CLEAR * np.count_nonzero(clear), FEW * np.count_nonzero(inliers)
    )


def _plane_errors(
    points0: np.ndarray, points1: np.ndarray, homography: np.ndarray | None
) -> np.ndarray:
    if homography is None:
        return np.full(len(points0), np.inf)
    return transfer_errors(points0, points1, homography)


def _no_overlap(matches: int) -> str:
    if not matches:
        return (
            "there are no matches: the photographs do not overlap, or do not show the same scene, "
            "or no pixel of one is above the threshold (lower it, or give a density)"
        )
    return (
        f"too few of the {matches:,} matches agree with one geometry: the photographs do not "
        "overlap, or do not show the same scene"
    )


def _no_depth(
    points0: np.ndarray, points1: np.ndarray, inliers: np.ndarray, calibration: Calibration | None
) -> str:
    if calibration is not None and _only_turned(points0[inliers], points1[inliers], calibration):
        return (
            "a turn of the camera explains all the matches and there is no depth: move it "
            "sideways between the photographs"
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
