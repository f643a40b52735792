"""Local features that benchmarks compare. Each consists of a detector and a descriptor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.errors import DeepDetectError, OptionError
from deepdetect._shared.records import file_digest
from deepdetect.detector.detector import find_keypoints
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import dominant_angles
from deepdetect.features.selection import SelectionOptions
from deepdetect.features.sift import DESCRIPTORS, scaled_sift_descriptors, to_root_sift
from deepdetect.io.image import luma


class BaselineError(DeepDetectError):
    """An external detector or descriptor failed or returned unusable values."""


@dataclass(frozen=True)
class LocalFeature:
    """A detector and its descriptor, with a name such as "sift-low" and a title for tables.

    Attributes:
        detect: function from an (H, W, 3) uint8 RGB image to its keypoints.
        describe: function from the image and its N keypoints to (N, D) descriptors.
        binary: whether descriptors are compared by Hamming instead of Euclidean distance.
        learned: whether descriptors were learned with their detector, and need no ratio test.
        version: text that changes whenever the results change. It is part of the key in the cache.
        detection: key of the cached keypoints, shared by features with the same detector. The
            default consists of name and version.
        own_scale: descriptor that uses the keypoints' own sizes. None if keypoints have no sizes.
    """

    name: str
    title: str
    detect: Callable[[np.ndarray], Keypoints]
    describe: Callable[[np.ndarray, Keypoints], np.ndarray]
    binary: bool = False
    learned: bool = False
    version: str = "1"
    detection: str = ""
    own_scale: OwnScaleDescriptor | None = None

    def __post_init__(self) -> None:
        if not self.detection:
            object.__setattr__(self, "detection", f"{self.name} {self.version}")

    @property
    def key(self) -> tuple[str, str]:
        """Name and version, which identify the feature in the keys of cached results."""
        return self.name, self.version


@dataclass(frozen=True)
class PointDescriptor:
    """A descriptor with the same size and angle for all keypoints, by default those of the paper.

    The paper's code leaves OpenCV's angle unset, at -1, which SIFT takes as -1 degree.
    """

    name: str = "sift"
    size_px: float = 3.0
    angle_deg: float = -1.0

    def describe(self, rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        """Return the (N, D) descriptors of N keypoints."""
        return DESCRIPTORS[self.name](luma(rgb), features.xy, self.size_px, self.angle_deg)


PAPER_DESCRIPTOR = PointDescriptor()

COMMON_DESCRIPTOR = PointDescriptor("rootsift", 4.0, 0.0)
"""The standard protocol uses this descriptor for classical detectors and DeepDetect, so that only
their keypoints differ. External detectors get it if they have no descriptor of their own."""


@dataclass(frozen=True)
class OwnScaleDescriptor:
    """RootSIFT descriptors at the keypoints' own sizes and angles.

    A descriptor covers a square with a side of 6 * `size_factor` * size (diameter) of the keypoint.
    Keypoints without angles get the angle of the dominant gradient around them.
    """

    size_factor: float = 1.0

    def describe(self, rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        """Describe keypoints at their positions, sizes and angles; return (N, 128) uint8."""
        if features.sizes is None:  # no keypoint was found
            return np.zeros((0, 128), np.uint8)
        gray = luma(rgb)
        sizes = self.size_factor * features.sizes
        angles = features.angles
        if angles is None:
            angles = dominant_angles(gray, features.xy, sizes)
        return to_root_sift(scaled_sift_descriptors(gray, features.xy, sizes, angles))


def with_own_scale(feature: LocalFeature) -> LocalFeature:
    """Return a copy of a feature whose descriptors use the keypoints' own sizes and angles."""
    if feature.own_scale is None:
        raise OptionError(f"the keypoints of {feature.title} have no sizes of their own")
    title = f"{feature.title}, own size and angle"
    return _described(feature, feature.own_scale, f"{feature.name}-own-scale", title)


def with_common_descriptor(feature: LocalFeature) -> LocalFeature:
    """Return a copy of a feature with `COMMON_DESCRIPTOR`, for the standard protocol."""
    return _described(feature, COMMON_DESCRIPTOR, f"{feature.name}-common", feature.title)


def _described(
    feature: LocalFeature, descriptor: PointDescriptor | OwnScaleDescriptor, name: str, title: str
) -> LocalFeature:
    """Return a copy with another descriptor. Keypoints at equal positions (SIFT) become one."""
    return replace(
        feature,
        name=name,
        title=title,
        detect=lambda rgb: feature.detect(rgb).distinct(),
        describe=descriptor.describe,
        binary=False,
        version=f"{feature.version} {descriptor}",
        detection=f"{feature.detection}, distinct",
    )


def deepdetect_feature(
    detector: Any,
    selection: SelectionOptions = SelectionOptions(),
    *,
    name: str = "deepdetect",
    title: str = "DeepDetect",
    descriptor: PointDescriptor = PAPER_DESCRIPTOR,
    version: str = "",
) -> LocalFeature:
    """Make a local feature from a DeepDetect, or from another detector if `version` is given."""
    if not version:
        digest = file_digest(detector.weights)[:16]
        version = f"{digest} {detector.runtime} {detector.heatmap_options} {selection} {descriptor}"

    def detect(rgb: np.ndarray) -> Keypoints:
        return find_keypoints(detector, rgb, selection)

    return LocalFeature(name, title, detect, descriptor.describe, version=version)


def points_feature(ranker: str | Path | None = None) -> LocalFeature:
    """Make a local feature from the ranked multi-scale keypoints of a `PointDetector`."""
    detector = PointDetector(None, resolution="native", ranker=ranker)
    return LocalFeature(
        "deepdetect-points",
        "DeepDetect, points",
        detector.detect,
        PAPER_DESCRIPTOR.describe,
        version=str(detector.settings),
        own_scale=OwnScaleDescriptor(),
    )
