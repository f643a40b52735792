"""What the drop-ins share: the best keypoints of an image, with descriptors."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .._shared.errors import OptionError
from ..detector.detector import DeepDetect
from ..detector.image_points import find_points
from ..features.keypoints import Keypoints
from ..features.orientation import dominant_angles
from ..features.selection import SelectionOptions
from ..features.sift import described_at_own_size
from ..io.image import load_image, luma

if TYPE_CHECKING:
    import torch

Spread = Literal["none", "grid", "anms"]

OVERSHOOT = 0.25
"""Of the values of tensors beyond [0, 1] that is cut off: bicubic filters leave some."""


class PointExtractor:
    """Finds the best keypoints of all scales, and describes them by RootSIFT at their own size.

    Args:
        max_keypoints: at most this many.
        spread: "none", "grid" or "anms", as of `DeepDetect.detect`.
        detector: with options of its own; None: the default one, of which only the ranker is used.

    Raises:
        OptionError: an option is unknown or out of its range.

    Example:
        >>> image = np.zeros((64, 64, 3), np.uint8)
        >>> image[20:40, 24:44] = 255
        >>> PointExtractor(4).detect_and_describe(image).descriptors.shape
        (4, 128)
    """

    def __init__(
        self,
        max_keypoints: int = 2048,
        spread: Spread = "none",
        detector: DeepDetect | None = None,
    ) -> None:
        if max_keypoints is None:
            raise OptionError("`max_keypoints` is needed: how many of the best keypoints")
        self._options = SelectionOptions(max_keypoints=max_keypoints, spread=spread, mode="points")
        self._detector = detector

    def detect(self, rgb: np.ndarray, ignore: np.ndarray | None = None) -> Keypoints:
        """Return keypoints of (H, W, 3) uint8 with sizes and angles, best first.

        Args:
            rgb: as `load_image` returns it.
            ignore: (H, W), true where no keypoint is wanted.
        """
        options = dataclasses.replace(self._options, ignore=ignore)
        if self._detector is None:
            return find_points(rgb, options)
        return self._detector.detect(
            rgb,
            max_keypoints=options.max_keypoints,
            ignore=ignore,
            mode="points",
            spread=options.spread,
        )

    def describe(self, rgb: np.ndarray, points: Keypoints) -> Keypoints:
        """Return keypoints of an image with (N, 128) uint8 RootSIFT descriptors.

        Args:
            rgb: (H, W, 3) uint8.
            points: with sizes; angles that are not given, or -1, are found.

        Raises:
            OptionError: they have no sizes above 0.
        """
        gray = luma(rgb)
        if points.sizes is None or not (points.sizes > 0).all():
            raise OptionError("keypoints need sizes above 0 to be described: give them some")
        angles = np.full(len(points), -1) if points.angles is None else points.angles
        unset = np.flatnonzero(angles < 0)
        if len(unset):
            angles = angles.astype(np.float32)
            angles[unset] = dominant_angles(gray, points.xy[unset], points.sizes[unset])
        return described_at_own_size(gray, dataclasses.replace(points, angles=angles))

    def detect_and_describe(self, rgb: np.ndarray, ignore: np.ndarray | None = None) -> Keypoints:
        """Do both; arguments as of `detect`."""
        return self.describe(rgb, self.detect(rgb, ignore))


def unit_descriptors(points: Keypoints) -> np.ndarray:
    """Return (N, D) float32 descriptors of keypoints, each of length 1.

    Example:
        >>> points = Keypoints([[3, 4]], [1], (8, 8), descriptors=np.array([[3, 4]], np.uint8))
        >>> unit_descriptors(points).tolist()
        [[0.6000000238418579, 0.800000011920929]]
    """
    assert points.descriptors is not None
    descriptors = points.descriptors.astype(np.float32)
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    unit: np.ndarray = descriptors / np.maximum(lengths, np.finfo(np.float32).tiny)
    return unit


def image_from_tensor(image: torch.Tensor) -> np.ndarray:
    """Return a (C, H, W) tensor as (H, W, 3) uint8 RGB.

    Args:
        image: of 1 or 3 channels, red first, in [0, 1].

    Raises:
        ImageError: the image is not fit, as of `load_image`.
    """
    values: Any = image.detach().float().cpu().numpy()
    if values.size and values.min() >= -OVERSHOOT and values.max() <= 1 + OVERSHOOT:
        values = np.clip(values, 0, 1)
    return load_image(values.transpose(1, 2, 0))
