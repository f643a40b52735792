"""The published pipeline, step by step as the authors' notebook runs it: what time is measured on.

Its results come from the preset `published` too; this is the way there that users had so far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ..bundled import BUNDLED
from ..detector import DeepDetect
from ..errors import MissingExtraError, WeightsError

RATIO = 0.99

STEREO_RATIO = 0.8**0.5
STEREO_THRESHOLD = 0.5
"""For stereo: the ratio of distances (0.8 of their squares) and RANSAC's threshold in pixels. The
paper does not tell them; with its second weights these give its counts on cones and cloth within
half a per cent, and no nearer one on moebius (485,000 for 363,703)."""

Judge = Callable[[float, float, float, float], bool]
"""Tells whether the match of (x, y) and (u, v) is right."""


def published_detector(detector: DeepDetect) -> DeepDetect:
    """Return a detector of the same weights run by torch without compilation.

    Raises:
        WeightsError: there is no safetensors file beside the weights.
        MissingExtraError: torch is not installed.
    """
    weights = detector.weights.with_suffix(".safetensors")
    if not weights.is_file():
        raise WeightsError(
            f"the published pipeline runs in torch and needs {weights}, which is not there: name "
            f"a safetensors file, or one of {', '.join(BUNDLED)}"
        )
    try:
        found = DeepDetect(weights, backend="torch")
    except MissingExtraError as error:
        raise MissingExtraError(f"the published pipeline is left out: {error}") from None
    return found.configured(detector.heatmap_options)


def published_pipeline(images: Sequence[np.ndarray], detector: DeepDetect, right: Judge) -> int:
    """Detect, describe and match two images, and count the matches that are right.

    Lists of `cv2.KeyPoint`, OpenCV's SIFT, FLANN with 5 trees and 50 checks, and loops in Python
    for the ratio test and for the count.

    Args:
        images: two, (H, W, 3) uint8 RGB.
        detector: of `published_detector`.
        right: judges a match.

    Returns:
        The number of right matches.
    """
    first, second, good = _matches(images, detector)
    count = 0
    for match in good:
        count += right(*first[match.queryIdx].pt, *second[match.trainIdx].pt)
    return count


def published_points(
    images: Sequence[np.ndarray],
    detector: DeepDetect,
    camera: np.ndarray,
    done: Callable[[str], object] = lambda stage: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Match a stereo pair and keep what the essential matrix leaves, the paper's "voxels".

    RANSAC with a confidence of 0.999, pose, and triangulation, by OpenCV.

    Args:
        images: two, (H, W, 3) uint8 RGB.
        detector: of `published_detector`.
        camera: (3, 3), of both images.
        done: called with "keypoints", "matching" and "geometry" when that is finished.

    Returns:
        (M, 2) and (M, 2) float64 positions of the matches that are left.
    """
    first, second, good = _matches(images, detector, done, STEREO_RATIO)
    points0 = np.array([first[match.queryIdx].pt for match in good]).reshape(-1, 2)
    points1 = np.array([second[match.trainIdx].pt for match in good]).reshape(-1, 2)
    done("matching")
    if len(good) < 6:
        return points0[:0], points1[:0]
    essential, inliers = cv2.findEssentialMat(
        points0, points1, camera, cv2.RANSAC, 0.999, STEREO_THRESHOLD
    )
    kept = inliers.ravel() > 0
    points0, points1 = points0[kept], points1[kept]
    _, rotation, translation, _ = cv2.recoverPose(essential[:3], points0, points1, camera)
    poses = np.eye(3, 4), np.column_stack([rotation, translation])
    cv2.triangulatePoints(*(camera @ pose for pose in poses), points0.T, points1.T)
    done("geometry")
    return points0, points1


def _matches(
    images: Sequence[np.ndarray],
    detector: DeepDetect,
    done: Callable[[str], object] = lambda stage: None,
    ratio: float = RATIO,
) -> tuple[Sequence[cv2.KeyPoint], Sequence[cv2.KeyPoint], list[cv2.DMatch]]:
    sift = cv2.SIFT_create()
    keypoints = []
    for image in images:
        mask = detector.heatmap(image) > 0.5
        keypoints.append([cv2.KeyPoint(float(x), float(y), 3) for y, x in np.argwhere(mask)])
    done("keypoints")
    (first, descriptors0), (second, descriptors1) = (
        sift.compute(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), own)
        for image, own in zip(images, keypoints, strict=True)
    )
    if not first or not second:
        return first, second, []
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
    good = []
    for best, next_best in matcher.knnMatch(descriptors0, descriptors1, k=2):
        if best.distance / (next_best.distance + 1e-12) < ratio:
            good.append(best)
    return first, second, good
