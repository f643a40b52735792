"""Conversion of tensors to images, and of arrays to tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..io.image import load_image

if TYPE_CHECKING:
    import torch

OVERSHOOT = 0.25
"""Tensor values up to this far outside [0, 1] are clipped, because bicubic filters overshoot."""


def load_tensor(image: Any) -> np.ndarray:
    """Read an image as `load_image` does; clip values of a tensor slightly outside [0, 1]."""
    if hasattr(image, "detach") and image.is_floating_point():
        image = image.detach().float().cpu().numpy()
        if image.size and image.min() >= -OVERSHOOT and image.max() <= 1 + OVERSHOOT:
            image = np.clip(image, 0, 1)
    return load_image(image)


def padded(rows: Sequence[Any], device: torch.device) -> torch.Tensor:
    """Stack B arrays or tensors (N_i, ...) into one tensor (B, max N_i, ...), padded with zeros."""
    import torch

    tensors = [torch.as_tensor(values) for values in rows]
    return torch.nn.utils.rnn.pad_sequence(tensors, batch_first=True).to(device)
