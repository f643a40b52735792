"""OpenCV: a detector and descriptor with the methods of `cv2.Feature2D`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels, check_channels
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from ..detector.point_detector import PointDetector
from ..detector.points.ranker import LOGIT_AS_SIFT
from ..features.keypoints import Keypoints
from ..features.learned import LENGTH
from ..features.scale_space import packed_octaves
from ..features.selection import check_max_keypoints
from ..features.sift import ROOT_SIFT
from ..io.image import load_image


class DeepDetectFeature2D:
    """Detector and descriptor of the best keypoints of all scales, which replaces `cv2.SIFT`.

    It has the methods of `cv2.Feature2D` but is not a subclass, because a subclass in Python would
    crash the interpreter. Functions of OpenCV that need a `cv2.Feature2D` therefore reject it.

    Args:
        detector: the detector, which also computes descriptors. Default: a `PointDetector`.
        max_keypoints: maximum number of keypoints per image. None: the detector's own or, without a
            detector, about as many as `cv2.SIFT` finds.
        channels: order of the colours in images: "bgr" as in `cv2.imread`, or "rgb".

    Raises:
        OptionError: an option is unknown or out of its range.

    Example:
        >>> image = np.zeros((64, 64, 3), np.uint8)
        >>> image[20:40, 24:44] = 255
        >>> detector = DeepDetectFeature2D(PointDetector(4))
        >>> keypoints, descriptors = detector.detectAndCompute(image, None)
        >>> len(keypoints), descriptors.shape
        (4, (4, 64))
    """

    @suggest_keywords
    def __init__(
        self,
        detector: PointDetector | None = None,
        *,
        max_keypoints: int | None = None,
        channels: Channels = "bgr",
    ) -> None:
        check_channels(channels)
        check_max_keypoints(max_keypoints)
        self._channels, self._most = channels, max_keypoints
        if detector is None:
            least = LOGIT_AS_SIFT if max_keypoints is None else None
            detector = PointDetector(max_keypoints, min_logit=least)
        self._detector = detector

    def detect(self, image: Any, mask: np.ndarray | None = None) -> tuple[cv2.KeyPoint, ...]:
        """Detect keypoints.

        Args:
            image: (H, W) or (H, W, C) array.
            mask: (H, W), not 0 where keypoints are allowed.

        Returns:
            The keypoints, best first. Sizes are diameters in pixels, angles are degrees, responses
            are scores, and octaves are those at which `cv2.SIFT` describes the keypoints.

        Raises:
            ImageError: the image has a wrong shape or type, or is too small.
            OptionError: the mask and the image differ in size.
        """
        return _to_opencv(self._find(self._load(image), mask))

    def compute(
        self, image: Any, keypoints: Sequence[cv2.KeyPoint], descriptors: None = None
    ) -> tuple[tuple[cv2.KeyPoint, ...], np.ndarray | None]:
        """Describe keypoints of this or any other detector.

        Args:
            image: as in `detect`.
            keypoints: keypoints with sizes. An angle of -1 is unknown, and is estimated.
            descriptors: not used, but an argument in OpenCV.

        Returns:
            The same keypoints, and (N, D) float32 descriptors, which are None if there are no
            keypoints, as in OpenCV. A learned descriptor has 64 numbers; RootSIFT has 128 integers
            in [0, 255].
        """
        rgb = self._load(image)
        points = Keypoints.from_opencv(keypoints, (rgb.shape[1], rgb.shape[0]))
        if not len(points):
            return (), None
        return tuple(keypoints), _as_float(self._detector.describe(rgb, points))

    def detectAndCompute(
        self,
        image: Any,
        mask: np.ndarray | None = None,
        descriptors: None = None,
        useProvidedKeypoints: bool = False,
    ) -> tuple[tuple[cv2.KeyPoint, ...], np.ndarray | None]:
        """Detect and describe keypoints: `detect` and `compute` in one.

        Raises:
            OptionError: `useProvidedKeypoints` is set. Use `compute` to describe given keypoints.
        """
        if useProvidedKeypoints:
            raise OptionError("`useProvidedKeypoints` is not supported: use the method `compute`")
        rgb = self._load(image)
        points = self._detector.describe(rgb, self._find(rgb, mask))
        return _to_opencv(points), _as_float(points) if len(points) else None

    def descriptorSize(self) -> int:
        """Return the number of values in a descriptor."""
        return 128 if self._detector.descriptor_type == ROOT_SIFT else LENGTH

    def descriptorType(self) -> int:
        """Return OpenCV's number of the type of descriptors, float32 as in `cv2.SIFT`."""
        return cv2.CV_32F

    def defaultNorm(self) -> int:
        """Return OpenCV's number of the norm that compares descriptors, for `cv2.BFMatcher`."""
        return cv2.NORM_L2

    def empty(self) -> bool:
        """Return False, which in OpenCV means that the detector can be used."""
        return False

    def getDefaultName(self) -> str:
        """Return the name of the algorithm."""
        return "Feature2D.DeepDetect"

    def _find(self, rgb: np.ndarray, mask: np.ndarray | None) -> Keypoints:
        """Detect keypoints where OpenCV's mask is not 0."""
        ignore = None if mask is None else np.asarray(mask) == 0
        return self._detector.detect(rgb, ignore=ignore, max_keypoints=self._most)

    def _load(self, image: Any) -> np.ndarray:
        return load_image(image, channels=self._channels)


def _to_opencv(points: Keypoints) -> tuple[cv2.KeyPoint, ...]:
    """Convert keypoints to `cv2.KeyPoint`, with the octaves at which `cv2.SIFT` describes them."""
    assert points.sizes is not None
    octaves = packed_octaves(points.sizes, points.image_size)
    return tuple(dataclasses.replace(points, octaves=octaves).to_opencv())


def _as_float(points: Keypoints) -> np.ndarray:
    assert points.descriptors is not None
    return points.descriptors.astype(np.float32)
