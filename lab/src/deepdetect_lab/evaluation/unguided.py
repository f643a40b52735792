"""Match by descriptors alone, as in the paper, for comparison with guided matching."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from deepdetect.detector.detector import AnyDetector, find_keypoints
from deepdetect.features.matches import Matches
from deepdetect.features.selection import SelectionOptions
from deepdetect.io.image import load_image
from deepdetect.matching import match_features

from .baselines.method import PAPER_DESCRIPTOR, PointDescriptor

PAPER_RATIO = 0.99
"""Threshold of the ratio test in the paper's published code."""

UPRIGHT_SIFT = PointDescriptor(angle_deg=0.0)
"""SIFT descriptor with the paper's keypoint size of 3 px, but the angle 0 instead of -1 degree."""


def match_unguided(
    image0: Any,
    image1: Any,
    detector: AnyDetector,
    *,
    selection: SelectionOptions | None = None,
    descriptor: PointDescriptor = PAPER_DESCRIPTOR,
    matcher: str = "flann",
    ratio: float = PAPER_RATIO,
    mutual: bool = False,
    seed: int = 0,
) -> Matches:
    """Match the keypoints of two images by their descriptors, without estimating a geometry.

    Args:
        image0, image1: images in any form that `load_image` accepts.
        detector: object with a method `heatmap` or `detect`.
        selection: which pixels of a heat map become keypoints. None: all with a probability over
            0.5.
        descriptor: type of the descriptors, and the size and angle that all keypoints get.
        matcher, ratio, mutual, seed: as in `match_features`.
    """
    start = time.perf_counter()
    features = []
    for image in (image0, image1):
        rgb = load_image(image)
        found = find_keypoints(detector, rgb, selection)
        values = descriptor.describe(rgb, found)
        plain = replace(found, sizes=None, angles=None)
        features.append(replace(plain, descriptors=values, descriptor_type=descriptor.name))
    matches = match_features(*features, matcher=matcher, ratio=ratio, mutual=mutual, seed=seed)
    return replace(matches, seconds={"matching": time.perf_counter() - start})
