"""kornia: modules that detect and describe keypoints as local affine frames (LAFs)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._shared.errors import OptionError, require_packages
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints, unit_length
from .tensors import load_tensor, padded

require_packages("the drop-in for kornia", "torch", "kornia")

import torch
from kornia.feature import laf_from_center_scale_ori
from torch import Tensor
from torch.nn import Module

LAF_SCALE_PER_SIZE = 3.0
"""Ratio of the scale of a local affine frame (LAF) to the keypoint's diameter, which is 2 sigma.
The scale, 6 sigma as in SIFT, is half the side of the described patch."""


class DeepDetectDetector(Module):
    """Detector of the best keypoints of all scales, for `kornia.feature.LocalFeature`.

    It replaces `kornia.feature.ScaleSpaceDetector`; kornia computes the descriptors. Gradients do
    not pass through the detector.

    Args:
        detector: the detector. Default: `PointDetector()`.

    Raises:
        OptionError: an option is unknown or out of its range.
    """

    def __init__(self, detector: PointDetector | None = None) -> None:
        super().__init__()
        self._detector = PointDetector() if detector is None else detector

    def forward(self, img: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Detect keypoints.

        Args:
            img: (B, 1, H, W) or (B, 3, H, W) in [0, 1], grey or RGB.
            mask: (B, 1, H, W), above 0 where keypoints are allowed.

        Returns:
            (B, N, 2, 3) LAFs and (B, N) scores, best first. N is the largest number of keypoints in
            an image; other images are padded with LAFs and scores of 0, as in kornia.

        Raises:
            ImageError: an image has a wrong shape, type or range, or is too small.
        """
        return self._frames(_found(self._detector.detect, img, mask), img)

    def _frames(self, found: list[Keypoints], img: Tensor) -> tuple[Tensor, Tensor]:
        lafs = [self._lafs(points) for points in found]
        return padded(lafs, img.device), padded([points.scores for points in found], img.device)

    def _lafs(self, points: Keypoints) -> Tensor:
        assert points.sizes is not None
        assert points.angles is not None
        if not len(points):
            return torch.zeros(0, 2, 3)
        scales = torch.from_numpy(LAF_SCALE_PER_SIZE * points.sizes).view(1, -1, 1, 1)
        # Angles grow counterclockwise in kornia, clockwise in OpenCV and DeepDetect.
        angles = torch.from_numpy(-points.angles).view(1, -1, 1)
        lafs: Tensor = laf_from_center_scale_ori(torch.from_numpy(points.xy)[None], scales, angles)
        return lafs[0]


class DeepDetectFeature(DeepDetectDetector):
    """Detector of the best keypoints with descriptors, for `kornia.feature.LocalFeatureMatcher`.

    It replaces `kornia.feature.LocalFeature`; the descriptors are those of the `PointDetector`.
    Arguments and errors are those of `DeepDetectDetector`.
    """

    def forward(  # type: ignore[override]  # as kornia's features differ from its detectors
        self, img: Tensor, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Detect and describe keypoints.

        Args:
            img, mask: as in `DeepDetectDetector`.

        Returns:
            (B, N, 2, 3) LAFs and (B, N) scores as in `DeepDetectDetector`, and (B, N, D)
            descriptors of unit length: D is 64 for learned descriptors and 128 for RootSIFT.
        """
        found = _found(self._detector.extract, img, mask)
        descriptors = [unit_length(np.asarray(points.descriptors)) for points in found]
        return *self._frames(found, img), padded(descriptors, img.device)


def _found(find: Callable[..., Keypoints], img: Tensor, mask: Tensor | None) -> list[Keypoints]:
    images = [load_tensor(one) for one in img]
    if mask is None:
        return [find(image) for image in images]
    shape = (len(img), 1, *img.shape[-2:])
    if mask.shape != shape:
        raise OptionError(f"the mask must have the shape {shape}, not {tuple(mask.shape)}")
    hidden = (mask[:, 0] <= 0).cpu().numpy()
    return [find(image, ignore=where) for image, where in zip(images, hidden, strict=True)]
