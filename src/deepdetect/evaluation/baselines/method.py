"""What a benchmark compares: a detector with the descriptor that is used for its points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from ..._shared.errors import OptionError
from ...features.keypoints import Keypoints
from ...io.image import luma


@dataclass(frozen=True)
class Method:
    """A detector and its descriptor.

    Attributes:
        name: by which users choose it, as "sift-low".
        title: how tables name it, as "SIFT, low settings".
        detect: function from a (H, W, 3) uint8 RGB image to its features.
        describe: function from the image and its features to (N, D) descriptors.
        binary: the descriptors are compared by Hamming's distance, else by Euclid's.
        learned: the descriptors were learned for their detector and need no ratio test.
        control: the points know nothing of the image; the time they take tells nothing.
        version: what results depend on besides the name: cached ones of another are not used.
        detection: what the keypoints depend on, where several methods share them.
    """

    name: str
    title: str
    detect: Callable[[np.ndarray], Keypoints]
    describe: Callable[[np.ndarray, Keypoints], np.ndarray]
    binary: bool = False
    learned: bool = False
    control: bool = False
    version: str = "1"
    detection: str = ""

    def __post_init__(self) -> None:
        if not self.detection:
            object.__setattr__(self, "detection", f"{self.name} {self.version}")


def opencv_method(
    name: str,
    title: str,
    make_detector: Callable[[], cv2.Feature2D],
    make_descriptor: Callable[[], cv2.Feature2D] | None = None,
) -> Method:
    """Make a method of an OpenCV detector.

    Args:
        name, title: as of `Method`.
        make_detector: opens the detector; it is opened anew for each image.
        make_descriptor: opens what describes its points; default SIFT, as in the paper.
    """

    def detect(rgb: np.ndarray) -> Keypoints:
        found = make_detector().detect(luma(rgb), None)
        return Keypoints.from_opencv(found, (rgb.shape[1], rgb.shape[0]))

    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        return describe_with(make_descriptor or cv2.SIFT_create, rgb, features)

    return Method(name, title, detect, describe, binary=make_descriptor is not None)


def describe_with(
    make_descriptor: Callable[[], cv2.Feature2D], rgb: np.ndarray, features: Keypoints
) -> np.ndarray:
    """Compute OpenCV's descriptors, a row for each keypoint.

    A descriptor that cannot be computed, as of ORB near the border, is 0 throughout: such a row
    finds a partner by chance only, and no keypoint is lost from the count.

    Raises:
        OptionError: the descriptor moved or doubled keypoints.
    """
    descriptor = make_descriptor()
    dtype = np.uint8 if descriptor.descriptorType() == cv2.CV_8U else np.float32
    rows = np.zeros((len(features), descriptor.descriptorSize()), dtype)
    keypoints = features.to_opencv()
    for row, keypoint in enumerate(keypoints):
        keypoint.class_id = row
    described, found = descriptor.compute(luma(rgb), keypoints)
    if not len(described):
        return rows
    if len(described) > len(features):
        raise OptionError("the descriptor returned more keypoints than it was given")
    rows[[keypoint.class_id for keypoint in described]] = found
    return rows
