"""Methods that choose pixels of a heat map: DeepDetect, and the controls that know nothing.

Their points are all alike, so their SIFT descriptors have one size and one direction.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from ...detector.detector import DeepDetect, find_keypoints
from ...features.keypoints import Keypoints, bayer_order
from ...features.selection import SelectionOptions, select_keypoints
from ...features.sift import get_descriptor
from ...io.image import luma
from ..controls import RandomPoints
from .method import Method


@dataclass(frozen=True)
class PointDescriptor:
    """How points that have no size and direction of their own are described.

    Attributes:
        name: "sift", "rootsift" or "sift-opencv".
        size: diameter in pixels (paper: 3).
        angle: direction in degrees; -1 is OpenCV's "unset", as the paper's code leaves it.
    """

    name: str = "sift"
    size: float = 3.0
    angle: float = -1.0

    def describe(self, rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        """Describe keypoints by their positions alone; (N, D) float32."""
        return get_descriptor(self.name)(luma(rgb), features.xy, self.size, self.angle)


PAPER_DESCRIPTOR = PointDescriptor()

COMMON_DESCRIPTOR = PointDescriptor("rootsift", 4.0, 0.0)
"""What all detectors get that have no descriptors of their own, where they are compared."""


def deepdetect_method(
    detector: DeepDetect,
    selection: SelectionOptions = SelectionOptions(),
    *,
    name: str = "deepdetect",
    title: str = "DeepDetect",
    descriptor: PointDescriptor = PAPER_DESCRIPTOR,
) -> Method:
    """Make a method of a detector with weights and its way to choose pixels.

    Args:
        detector: with its resolution and order of channels.
        selection: threshold, suppression and number.
        name, title: as of `Method`.
        descriptor: of the points.
    """

    def detect(rgb: np.ndarray) -> Keypoints:
        points = find_keypoints(detector, rgb, selection)
        return Keypoints(points.xy, points.logits, points.image_size)

    digest = hashlib.sha256(detector.weights.read_bytes()).hexdigest()[:16]
    version = f"{digest} {detector.backend} {detector.heatmap_options} {selection} {descriptor}"
    return Method(name, title, detect, descriptor.describe, version=version)


def random_method(like: Method, seed: int = 0, *, name: str = "random") -> Method:
    """Make the control of random pixels, in each image as many as a method finds there.

    Args:
        like: the method.
        seed: of the random numbers; every image gets others.
        name: as of `Method`.
    """

    def detect(rgb: np.ndarray) -> Keypoints:
        # The image decides too, so that both images of a pair do not get the same pixels.
        own = int.from_bytes(hashlib.sha256(rgb.tobytes()).digest()[:4], "little")
        count = len(like.detect(rgb))
        size = (rgb.shape[1], rgb.shape[0])
        if not count:
            return Keypoints(np.empty((0, 2)), np.empty(0), size)
        options = SelectionOptions(threshold=0, max_keypoints=count, nms_radius=0, subpixel=False)
        points = select_keypoints(RandomPoints(seed + own).heatmap(rgb), options)
        return Keypoints(points.xy, points.scores, size)

    title = f"control: as many random points as {like.title}"
    version = f"{like.name} {like.version} {seed}"
    return Method(name, title, detect, PAPER_DESCRIPTOR.describe, control=True, version=version)


def every_pixel_method() -> Method:
    """Make the control that takes every pixel; its best ones form an even grid, however many."""

    def detect(rgb: np.ndarray) -> Keypoints:
        height, width = rgb.shape[:2]
        row, column = (part.ravel() for part in np.indices((height, width)))
        xy = np.column_stack([column, row])
        return Keypoints(xy, 1 - bayer_order(xy, (width, height)), (width, height))

    title = "control: every pixel (a grid, where there is a budget)"
    return Method("every-pixel", title, detect, PAPER_DESCRIPTOR.describe, control=True)
