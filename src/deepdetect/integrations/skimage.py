"""scikit-image: an object with the methods and attributes of `skimage.feature.SIFT`.

Positions are (row, column), as everywhere in scikit-image; the centre of the first pixel is (0, 0).
It needs nothing of scikit-image itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .._shared.errors import OptionError
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints
from ..features.scale_space import SIZE_PER_SIGMA
from ..io.image import load_image


class DeepDetectFeatures:
    """The best keypoints of all scales, with descriptors.

    Args:
        detector: of the points and their descriptors.

    Attributes:
        keypoints: (N, 2) float32 positions as (row, column), best first.
        scales: (N,) float32 sigmas in pixels, as `skimage.feature.SIFT.sigmas`.
        orientations: (N,) float32 in radians from columns towards rows, as of
            `skimage.feature.corner_orientations`.
        responses: (N,) float32 scores, the higher the better.
        descriptors: (N, 64) float32 learned ones, or (N, 128) uint8 RootSIFT.

    All are None before the first image.

    Raises:
        OptionError: an option is unknown or out of its range.

    Example:
        >>> image = np.zeros((64, 64))
        >>> image[20:40, 24:44] = 1
        >>> features = DeepDetectFeatures(PointDetector(4))
        >>> features.detect_and_extract(image)
        >>> features.keypoints.shape, features.descriptors.shape
        ((4, 2), (4, 64))
    """

    keypoints: np.ndarray | None = None
    scales: np.ndarray | None = None
    orientations: np.ndarray | None = None
    responses: np.ndarray | None = None
    descriptors: np.ndarray | None = None

    def __init__(self, detector: PointDetector | None = None) -> None:
        self._detector = PointDetector() if detector is None else detector

    def detect(self, image: Any) -> None:
        """Detect keypoints, and set all attributes but `descriptors`.

        Args:
            image: (H, W) or (H, W, 3) array, float in [0, 1] or integers without sign.

        Raises:
            ImageError: the image is not fit.
        """
        self._set(self._detector.detect(load_image(image)))

    def extract(
        self,
        image: Any,
        keypoints: np.ndarray | None = None,
        scales: np.ndarray | float | None = None,
        orientations: np.ndarray | None = None,
    ) -> None:
        """Describe keypoints, and set `descriptors`.

        Args:
            image: as of `detect`.
            keypoints: (N, 2) positions as (row, column), also of other detectors. None: those that
                were detected, at their scales and orientations.
            scales: (N,) or one sigma in pixels, of given keypoints.
            orientations: (N,) in radians, of given keypoints; None: they are found.

        Raises:
            OptionError: there are no keypoints yet, or given ones have no scales.
        """
        if keypoints is None:
            if scales is not None or orientations is not None:
                raise OptionError("scales and orientations belong to keypoints: give these, too")
            keypoints, scales, orientations = self.keypoints, self.scales, self.orientations
            if keypoints is None:
                raise OptionError("there are no keypoints yet: call detect first, or give some")
        if scales is None:
            raise OptionError("keypoints need scales to be described: give their sigmas in pixels")
        rgb = load_image(image)
        xy = np.asarray(keypoints, np.float32)[..., ::-1]
        sizes = np.asarray(scales) * SIZE_PER_SIGMA
        given = Keypoints(
            xy,
            np.zeros(len(xy)),
            (rgb.shape[1], rgb.shape[0]),
            sizes=np.full(len(xy), sizes) if sizes.ndim == 0 else sizes,
            angles=None if orientations is None else np.rad2deg(np.asarray(orientations)) % 360,
        )
        self.descriptors = self._detector.describe(rgb, given).descriptors

    def detect_and_extract(self, image: Any) -> None:
        """Detect and describe keypoints, and set all attributes; argument as of `detect`."""
        self._set(self._detector.extract(load_image(image)))

    def _set(self, points: Keypoints) -> None:
        assert points.sizes is not None
        assert points.angles is not None
        self.keypoints = np.ascontiguousarray(points.xy[:, ::-1])
        self.scales = points.sizes / np.float32(SIZE_PER_SIGMA)
        self.orientations = np.deg2rad(points.angles)
        self.responses = points.scores
        self.descriptors = points.descriptors
