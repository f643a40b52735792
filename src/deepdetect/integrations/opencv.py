"""OpenCV: an object with the methods of `cv2.Feature2D`."""

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
from ..features.keypoints import Keypoints
from ..features.learned import LENGTH
from ..features.scale_space import packed_octaves
from ..features.sift import ROOT_SIFT
from ..io.image import load_image


class DeepDetectFeature2D:
    """The best keypoints of all scales, with descriptors, as `cv2.SIFT` gives them.

    It has the methods of `cv2.Feature2D`, but does not derive from it: a Python class that does
    crashes the interpreter. So functions of OpenCV that ask for a `cv2.Feature2D` refuse it.

    Args:
        detector: of the points and their descriptors.
        channels: order of the colours in images: "bgr" as of `cv2.imread`, or "rgb".

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
        self, detector: PointDetector | None = None, *, channels: Channels = "bgr"
    ) -> None:
        check_channels(channels)
        self._channels = channels
        self._detector = PointDetector() if detector is None else detector

    def detect(self, image: Any, mask: np.ndarray | None = None) -> tuple[cv2.KeyPoint, ...]:
        """Detect keypoints.

        Args:
            image: (H, W) or (H, W, C) array.
            mask: (H, W), not 0 where keypoints are wanted.

        Returns:
            The keypoints, best first: sizes are diameters in pixels, angles degrees, responses
            scores; the octaves are those at which `cv2.SIFT` describes them.

        Raises:
            ImageError: the image is not fit.
            OptionError: the mask has another size than the image.
        """
        return _to_opencv(self._detector.detect(self._load(image), ignore=_ignored(mask)))

    def compute(
        self, image: Any, keypoints: Sequence[cv2.KeyPoint], descriptors: None = None
    ) -> tuple[tuple[cv2.KeyPoint, ...], np.ndarray | None]:
        """Describe keypoints, also of other detectors.

        Args:
            image: as of `detect`.
            keypoints: with sizes; angles of -1 are found.
            descriptors: not used; OpenCV has this argument.

        Returns:
            The same keypoints, and (N, D) float32 descriptors: 64 learned numbers, or 128 of
            RootSIFT, whole ones from 0 to 255 (None without keypoints, as OpenCV does).
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
            OptionError: `useProvidedKeypoints` is set: `compute` describes given keypoints.
        """
        if useProvidedKeypoints:
            raise OptionError("`useProvidedKeypoints` is not supported: use the method compute")
        points = self._detector.extract(self._load(image), ignore=_ignored(mask))
        return _to_opencv(points), _as_float(points) if len(points) else None

    def descriptorSize(self) -> int:
        """Return the length of a descriptor."""
        return 128 if self._detector.descriptor_type == ROOT_SIFT else LENGTH

    def descriptorType(self) -> int:
        """Return the type of descriptors, float32 as of `cv2.SIFT`."""
        return cv2.CV_32F

    def defaultNorm(self) -> int:
        """Return the norm to compare descriptors by, for `cv2.BFMatcher`."""
        return cv2.NORM_L2

    def empty(self) -> bool:
        """Return False: it can detect."""
        return False

    def getDefaultName(self) -> str:
        """Return the name of the algorithm."""
        return "Feature2D.DeepDetect"

    def _load(self, image: Any) -> np.ndarray:
        return load_image(image, channels=self._channels)


def _ignored(mask: np.ndarray | None) -> np.ndarray | None:
    """Turn OpenCV's mask of what is wanted into one of what is not."""
    return None if mask is None else np.asarray(mask) == 0


def _to_opencv(points: Keypoints) -> tuple[cv2.KeyPoint, ...]:
    """Convert keypoints with sizes, and note where in its scale space SIFT describes them."""
    assert points.sizes is not None
    octaves = packed_octaves(points.sizes, points.image_size)
    return tuple(dataclasses.replace(points, octaves=octaves).to_opencv())


def _as_float(points: Keypoints) -> np.ndarray:
    assert points.descriptors is not None
    return points.descriptors.astype(np.float32)
