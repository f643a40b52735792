"""Images from tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..io.image import load_image

if TYPE_CHECKING:
    import torch

OVERSHOOT = 0.25
"""Of the values of tensors beyond [0, 1] that is cut off: bicubic filters leave some."""


def image_from_tensor(image: torch.Tensor) -> np.ndarray:
    """Return a (C, H, W) tensor of 1 or 3 channels, red first, in [0, 1], as (H, W, 3) uint8."""
    values: Any = image.detach().float().cpu().numpy()
    if values.size and values.min() >= -OVERSHOOT and values.max() <= 1 + OVERSHOOT:
        values = np.clip(values, 0, 1)
    return load_image(values.transpose(1, 2, 0))
