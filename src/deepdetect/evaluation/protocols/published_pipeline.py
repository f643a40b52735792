"""The published pipeline, step by step as the authors' notebook runs it: what time is measured on.

Its results come from the preset `published` too; this is the way there that users had so far.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ..._shared.errors import MissingExtraError, WeightsError
from ...detector.detector import DeepDetect
from ...detector.pretrained import PRETRAINED

RATIO = 0.99

TREES = 5
CHECKS = 50

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
            f"a safetensors file, or one of {', '.join(PRETRAINED)}"
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
    first, second, good = published_matches(images, detector)
    count = 0
    for match in good:
        count += right(*first[match.queryIdx].pt, *second[match.trainIdx].pt)
    return count


def published_matches(
    images: Sequence[np.ndarray],
    detector: DeepDetect,
    ratio: float = RATIO,
    trees: int = TREES,
    checks: int = CHECKS,
    done: Callable[[str], object] = lambda stage: None,
) -> tuple[Sequence[cv2.KeyPoint], Sequence[cv2.KeyPoint], list[cv2.DMatch]]:
    """Detect, describe and match two images.

    Args:
        images: two, (H, W, 3) uint8 RGB.
        detector: of `published_detector`.
        ratio: of the ratio test.
        trees, checks: of FLANN.
        done: called with "keypoints" when these are found.

    Returns:
        The keypoints of both images and the matches that pass.
    """
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
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": trees}, {"checks": checks})
    good = []
    for best, next_best in matcher.knnMatch(descriptors0, descriptors1, k=2):
        if best.distance / (next_best.distance + 1e-12) < ratio:
            good.append(best)
    return first, second, good
