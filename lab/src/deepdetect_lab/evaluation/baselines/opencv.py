"""OpenCV's classical detectors, with default settings and with the low thresholds of the paper.

In the standard protocol, SIFT has the option `enable_precise_upscale`, unlike OpenCV's default.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.features.keypoints import Keypoints
from deepdetect.io.image import luma

from ...labels.factories import opencv_factory
from .method import LocalFeature, OwnScaleDescriptor

MAX_CORNERS = 1_000_000

KD_TREES = "bytes by kd-trees"

AGAST_7_12D = 1
"""OpenCV's AgastFeatureDetector::AGAST_7_12d: the paper's low settings use this type of AGAST."""

OPENCV_SETTINGS: dict[str, tuple[str, str, Mapping[str, Any]]] = {
    # SIFT: Lowe 2004. ORB: Rublee et al. 2011. BRISK: Leutenegger et al. 2011.
    "sift": ("SIFT", "SIFT_create", {}),
    # By default OpenCV shifts positions by a quarter of a pixel, as in the paper's tables.
    "sift-precise": ("SIFT", "SIFT_create", {"enable_precise_upscale": True}),
    "sift-low": (
        "SIFT, low settings",
        "SIFT_create",
        {"nOctaveLayers": 4, "contrastThreshold": 1e-9, "edgeThreshold": 100, "sigma": 0.7},
    ),
    "orb": ("ORB", "ORB_create", {}),
    "orb-many": ("ORB", "ORB_create", {"nfeatures": 10_000}),  # OpenCV's default is 500
    "orb-low": ("ORB, low settings", "ORB_create", {"nfeatures": 1_000_000, "fastThreshold": 1}),
    "brisk": ("BRISK", "BRISK_create", {}),
    "brisk-low": ("BRISK, low settings", "BRISK_create", {"thresh": 1, "octaves": 4}),
    # FAST (type 9-16): Rosten and Drummond 2006. AGAST: Mair et al. 2010.
    "fast": ("FAST", "FastFeatureDetector_create", {}),
    "fast-low": (
        "FAST, low settings",
        "FastFeatureDetector_create",
        {"threshold": 1, "nonmaxSuppression": False},
    ),
    "agast": ("AGAST", "AgastFeatureDetector_create", {}),
    "agast-low": (
        "AGAST, low settings",
        "AgastFeatureDetector_create",
        {"threshold": 1, "nonmaxSuppression": False, "type": AGAST_7_12D},
    ),
}
"""Title, OpenCV factory, and settings that differ from OpenCV's defaults, by name of the detector.
The paper's "low settings" have such low thresholds that detectors find many keypoints."""


def _make(name: str) -> cv2.Feature2D:
    _, factory, settings = OPENCV_SETTINGS[name]
    return opencv_factory(factory)(**settings)


def describe_with(descriptor: cv2.Feature2D, rgb: np.ndarray, features: Keypoints) -> np.ndarray:
    """Compute an (N, D) array of OpenCV descriptors, one row per keypoint.

    OpenCV drops some keypoints, for example near the border. Their descriptors are all 0.
    """
    dtype = np.uint8 if descriptor.descriptorType() == cv2.CV_8U else np.float32
    rows = np.zeros((len(features), descriptor.descriptorSize()), dtype)
    keypoints = features.to_opencv()
    for row, keypoint in enumerate(keypoints):
        keypoint.class_id = row
    described, found = descriptor.compute(luma(rgb), keypoints)
    if len(described):
        rows[[keypoint.class_id for keypoint in described]] = found
    return rows


def _feature(
    name: str,
    title: str,
    detect: Callable[[np.ndarray], Keypoints],
    descriptor: str,
    settings: Mapping[str, Any] = {},
) -> LocalFeature:
    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        return describe_with(opencv_factory(descriptor)(**settings), rgb, features)

    return LocalFeature(name, title, detect, describe, binary=descriptor != "SIFT_create")


def _opencv(name: str) -> LocalFeature:
    def detect(rgb: np.ndarray) -> Keypoints:
        found = _make(name).detect(luma(rgb), None)
        return Keypoints.from_opencv(found, (rgb.shape[1], rgb.shape[0]))

    title, factory, settings = OPENCV_SETTINGS[name]
    if name == "sift-precise":  # detector and descriptor upscale the image in the same way
        feature = _feature("sift", title, detect, factory, settings)
        return replace(feature, version="2", detection="", own_scale=OwnScaleDescriptor())
    binary = factory in ("ORB_create", "BRISK_create")
    return _feature(name, title, detect, factory if binary else "SIFT_create")


def self_described(name: str) -> LocalFeature:
    """Make a local feature that detects and describes by the method `OPENCV_SETTINGS[name]`."""
    return replace(
        _opencv(name),
        name=f"{name}-self-described",
        describe=lambda rgb, features: describe_with(_make(name), rgb, features),
    )


def _harris(
    name: str, title: str, block_size: int, aperture: int, k: float, quality: float
) -> LocalFeature:
    """Make the paper's Harris detector (Harris and Stephens, 1988), with many pixels per corner."""

    def detect(rgb: np.ndarray) -> Keypoints:
        response = cv2.dilate(cv2.cornerHarris(luma(rgb), block_size, aperture, k), None)
        return _pixels(response, response > quality * max(float(response.max()), 0.0))

    return _feature(name, title, detect, "SIFT_create")


def _harris_maxima(rgb: np.ndarray) -> Keypoints:
    """Detect Harris corners in the usual way: one keypoint per corner, ranked by response."""
    response = cv2.cornerHarris(luma(rgb), 3, 3, 0.04)
    return _pixels(response, (response == cv2.dilate(response, None)) & (response > 0))


def _pixels(response: np.ndarray, chosen: np.ndarray) -> Keypoints:
    row, column = np.nonzero(chosen)
    xy = np.column_stack([column, row])
    return Keypoints(xy, response[row, column], (chosen.shape[1], chosen.shape[0]))


def _shi_tomasi(name: str, title: str, quality: float, k: float) -> LocalFeature:
    """Make the paper's Shi-Tomasi detector, which in fact uses the Harris response."""

    def detect(rgb: np.ndarray) -> Keypoints:
        corners, scores = cv2.goodFeaturesToTrackWithQuality(
            luma(rgb), MAX_CORNERS, quality, 1, None, useHarrisDetector=True, k=k
        )
        return _corners(rgb, corners, scores)

    return _feature(name, title, detect, "SIFT_create")


def _shi_tomasi_eigenvalue(rgb: np.ndarray) -> Keypoints:
    """Detect Shi-Tomasi corners (1994) at sub-pixel positions, ranked by the smaller eigenvalue."""
    gray = luma(rgb)
    corners, scores = cv2.goodFeaturesToTrackWithQuality(
        gray, MAX_CORNERS, 1e-4, 1, None, blockSize=3
    )
    if corners is not None:
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
        fine = cv2.cornerSubPix(gray, corners.copy(), (2, 2), (-1, -1), criteria)
        # A refinement by 1 px or more has not converged to this corner, so it is undone.
        stayed = np.abs(fine - corners).max(2, keepdims=True) < 1
        corners = np.where(stayed, fine, corners)
    return _corners(rgb, corners, scores)


def _corners(rgb: np.ndarray, corners: np.ndarray | None, scores: np.ndarray) -> Keypoints:
    size = (rgb.shape[1], rgb.shape[0])
    if corners is None:
        return Keypoints.empty(size)
    return Keypoints(corners.reshape(-1, 2), scores.reshape(-1), size)


CLASSICAL: dict[str, LocalFeature] = {
    **{name: _opencv(name) for name in OPENCV_SETTINGS if name not in ("orb-many", "sift-precise")},
    "harris": _harris("harris", "Harris", 2, 3, 0.04, 0.04),
    "harris-low": _harris("harris-low", "Harris, low settings", 3, 5, 0.001, 0.001),
    "shi-tomasi": _shi_tomasi("shi-tomasi", "Shi-Tomasi", 0.01, 0.04),
    "shi-tomasi-low": _shi_tomasi("shi-tomasi-low", "Shi-Tomasi, low settings", 1e-6, 0.001),
}
"""The classical detectors of the paper's tables, with default and with low settings, by name."""

STANDARD: dict[str, LocalFeature] = {
    "sift": _opencv("sift-precise"),
    "orb": _opencv("orb-many"),
    "brisk": CLASSICAL["brisk"],
    "fast": CLASSICAL["fast"],
    "agast": CLASSICAL["agast"],
    "harris": _feature("harris-maxima", "Harris, local maxima", _harris_maxima, "SIFT_create"),
    "shi-tomasi": _feature(
        "shi-tomasi-eigenvalue", "Shi-Tomasi, sub-pixel", _shi_tomasi_eigenvalue, "SIFT_create"
    ),
}
"""Classical detectors of the standard protocol, which compares the best N keypoints. They differ
from `CLASSICAL` so that SIFT's positions are exact, and ORB, Harris and Shi-Tomasi find enough
keypoints and rank them by score."""


def with_kd_trees(features: Iterable[LocalFeature]) -> list[LocalFeature]:
    """After each binary feature with low settings, insert a copy that is matched by kd-trees.

    As in the paper, kd-trees compare the bytes of binary descriptors by Euclidean distance.
    """
    found: list[LocalFeature] = []
    for feature in features:
        found.append(feature)
        if feature.binary and feature.name.endswith("-low"):
            title = f"{feature.title}, {KD_TREES}"
            name = f"{feature.name}-kd-trees"
            found.append(replace(feature, name=name, title=title, binary=False))
    return found
