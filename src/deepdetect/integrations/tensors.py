"""What the drop-ins share: images from tensors, and descriptors of length 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..features.keypoints import Keypoints
from ..io.image import load_image

if TYPE_CHECKING:
    import torch

OVERSHOOT = 0.25
"""Of the values of tensors beyond [0, 1] that is cut off: bicubic filters leave some."""


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
