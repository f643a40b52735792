"""The learned descriptor of keypoints: a network of the whole image, read at their positions."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np

from ..._shared.opencv import cv2
from ...features.keypoints import Keypoints
from ...features.learned import LEARNED, LEARNED_FREE
from ..backends.onnxruntime_backend import start_session
from ..pretrained import RANKER

DESCRIPTOR_GRAPHS = {
    LEARNED: RANKER.with_name("descriptor.onnx"),
    LEARNED_FREE: RANKER.with_name("descriptor_free.onnx"),
}
"""Map `luma` (1, 1, H, W) in [0, 1], `xy` (1, N, 2) in pixels and `sizes` (1, N), diameters in
pixels, to `descriptors` (1, N, 64) of length 1, all float32."""

STRIDE = 128
"""The network halves an image seven times, so its sides must be multiples of 128."""


def describe_learned(
    gray: np.ndarray, keypoints: Keypoints, descriptor: str = LEARNED
) -> Keypoints:
    """Return keypoints with learned descriptors, upright ones, of a (H, W) uint8 image.

    The image may be a smaller one than that of the keypoints.
    """
    height, width = gray.shape
    factor = np.divide((width, height), keypoints.image_size).astype(np.float32)
    below, right = -height % STRIDE, -width % STRIDE
    padded = cv2.copyMakeBorder(gray, 0, below, 0, right, cv2.BORDER_REPLICATE)
    inputs = {
        "luma": padded[None, None].astype(np.float32) / 255,
        "xy": ((keypoints.xy + 0.5) * factor - 0.5)[None],
        "sizes": (keypoints.sizes * factor.mean())[None],
    }
    descriptors = _session(descriptor).run(["descriptors"], inputs)[0][0]
    return replace(keypoints, descriptors=descriptors, descriptor_type=descriptor)


@functools.cache
def _session(descriptor: str) -> Any:
    return start_session(str(DESCRIPTOR_GRAPHS[descriptor]), None)
