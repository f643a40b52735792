"""The loss and the overlap of predicted and true masks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, pad


@dataclass(frozen=True)
class MaskScore:
    """Means over images.

    Attributes:
        loss: binary cross-entropy a pixel.
        iou: intersection over union of the masks at threshold 0.5.
        images: number of images.
    """

    loss: float
    iou: float
    images: int


def score_masks(
    network: nn.Module, pairs: Iterable[tuple[np.ndarray, np.ndarray]], device: torch.device
) -> MaskScore:
    """Score a network on images with known masks, one image at a time, in float32.

    Args:
        network: maps (1, 3, H, W) RGB in [0, 1] to logits.
        pairs: (H, W, 3) uint8 RGB images and (H, W) bool masks.
        device: where the network is.

    Returns:
        Means over the images; an image whose two masks are empty has IoU 1.
    """
    was_training = network.training
    network.eval()
    losses, overlaps = [], []
    with torch.inference_mode():
        for rgb, mask in pairs:
            image = torch.from_numpy(np.ascontiguousarray(rgb)).to(device)
            truth = torch.from_numpy(np.ascontiguousarray(mask)).to(device)
            logits = padded_logits(network, image)
            losses.append(binary_cross_entropy_with_logits(logits, truth.float()).item())
            union = ((logits > 0) | truth).sum().item()
            shared = ((logits > 0) & truth).sum().item()
            overlaps.append(shared / union if union else 1.0)
    network.train(was_training)
    return MaskScore(float(np.mean(losses)), float(np.mean(overlaps)), len(losses))


def padded_logits(network: nn.Module, rgb: torch.Tensor) -> torch.Tensor:
    """Run the network on a (H, W, 3) uint8 image of any size; return (H, W) logits."""
    height, width = rgb.shape[:2]
    image = rgb.permute(2, 0, 1)[None].float().div_(255)
    image = pad(image, (0, -width % 8, 0, -height % 8), mode="replicate")
    image = image.contiguous(memory_format=torch.channels_last)
    return network(image)[0, 0, :height, :width].float()
