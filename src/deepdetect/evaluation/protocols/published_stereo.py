"""The published reconstruction, with the settings of the authors' notebooks.

Their keypoints or SIFT's, FLANN with 10 trees and 100 checks, a ratio chosen for each scene, and
the essential matrix by RANSAC: what that leaves are the paper's "voxels" (Figure 8).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from ...detector.detector import DeepDetect
from ...features.matchers import match_descriptors
from ...features.matchers.approximate import flann_neighbours
from ...io.image import luma
from ...matching.pipeline import check_memory
from .published_pipeline import published_matches

TREES = 10
CHECKS = 100
"""Of FLANN."""

CONFIDENCE = 0.99999
THRESHOLD = 0.5
ITERATIONS = 100_000
"""Of RANSAC; the threshold in pixels."""

Points = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class StereoSettings:
    """What the authors chose for a scene.

    Attributes:
        ratio: of the ratio test.
        focal_px: focal length in pixels.
        centre: (x, y) of the principal point.
    """

    ratio: float
    focal_px: float
    centre: tuple[float, float]

    @property
    def camera(self) -> np.ndarray:
        """(3, 3) camera matrix of both images."""
        (x, y), focal = self.centre, self.focal_px
        return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]], float)


SETTINGS: dict[str, StereoSettings] = {
    "cones": StereoSettings(0.9, 360, (225, 188)),
    "dolls": StereoSettings(0.85, 1512, (695, 555)),
    "moebius": StereoSettings(0.77, 1512, (695, 555)),
    "rocks": StereoSettings(0.9, 1512, (638, 555)),
    "cloth": StereoSettings(0.9, 1050, (641, 555)),
}
"""Of the paper's five scenes, from the authors' notebooks."""


def stereo_settings(scene: str, camera: np.ndarray) -> StereoSettings:
    """Return the authors' settings; for other scenes their most frequent ratio.

    Args:
        scene: its name.
        camera: (3, 3) of the calibration, for other scenes.
    """
    centre = float(camera[0, 2]), float(camera[1, 2])
    return SETTINGS.get(scene, StereoSettings(0.9, float(camera[0, 0]), centre))


def published_points(
    images: Sequence[np.ndarray],
    detector: DeepDetect,
    settings: StereoSettings,
    done: Callable[[str], object] = lambda stage: None,
) -> Points:
    """Match a stereo pair and keep what the essential matrix leaves, step by step as the authors.

    Pose and triangulation are made too, and timed.

    Args:
        images: two, (H, W, 3) uint8 RGB.
        detector: of `published_detector`.
        settings: of the scene.
        done: called with "keypoints", "matching" and "geometry" when that is finished.

    Returns:
        (M, 2) and (M, 2) float64 positions of the matches that are left.
    """
    first, second, good = published_matches(
        images, detector, settings.ratio, TREES, CHECKS, done=done
    )
    points0 = np.array([first[match.queryIdx].pt for match in good]).reshape(-1, 2)
    points1 = np.array([second[match.trainIdx].pt for match in good]).reshape(-1, 2)
    done("matching")
    found = _left_by_the_essential_matrix(points0, points1, settings.camera)
    done("geometry")
    return found


def sift_points(
    images: Sequence[np.ndarray],
    sift: cv2.SIFT,
    settings: StereoSettings,
    done: Callable[[str], object] = lambda stage: None,
) -> Points:
    """Do the same with SIFT's keypoints and their descriptors.

    Args:
        images, settings, done: as of `published_points`.
        sift: finds and describes.
    """
    grays = [luma(image) for image in images]
    keypoints = [sift.detect(gray) for gray in grays]
    done("keypoints")
    check_memory([len(one) for one in keypoints])
    (first, descriptors0), (second, descriptors1) = (
        sift.compute(gray, own) for gray, own in zip(grays, keypoints, strict=True)
    )
    flann = partial(flann_neighbours, trees=TREES, checks=CHECKS)
    found = match_descriptors(descriptors0, descriptors1, flann, ratio=settings.ratio)
    done("matching")
    points0, points1 = (
        np.array([own[row].pt for row in rows]).reshape(-1, 2)
        for own, rows in ((first, found.rows0), (second, found.rows1))
    )
    left = _left_by_the_essential_matrix(points0, points1, settings.camera)
    done("geometry")
    return left


def _left_by_the_essential_matrix(
    points0: np.ndarray, points1: np.ndarray, camera: np.ndarray
) -> Points:
    """Keep the inliers, and pose and triangulate them for the time that takes."""
    if len(points0) < 6:
        return points0[:0], points1[:0]
    essential, inliers = cv2.findEssentialMat(
        points0,
        points1,
        camera,
        method=cv2.RANSAC,
        prob=CONFIDENCE,
        threshold=THRESHOLD,
        maxIters=ITERATIONS,
    )
    if essential is None:
        return points0[:0], points1[:0]
    kept = inliers.ravel() > 0
    points0, points1 = points0[kept], points1[kept]
    _, rotation, translation, _ = cv2.recoverPose(essential[:3], points0, points1, camera)
    poses = np.eye(3, 4), np.column_stack([rotation, translation])
    cv2.triangulatePoints(*(camera @ pose for pose in poses), points0.T, points1.T)
    return points0, points1
