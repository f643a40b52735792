"""Scoring the network that is being trained."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import nn
from torch.nn.functional import pad

from ..evaluation.mask_scores import MaskScore, mean_score, score_heatmap


def score_network(
    network: nn.Module, pairs: Iterable[tuple[np.ndarray, np.ndarray]], device: torch.device
) -> MaskScore:
    """Score a network on images with known masks, one image at a time, in float32.

    Args:
        network: maps (1, 3, H, W) RGB in [0, 1] to logits.
        pairs: (H, W, 3) uint8 RGB images and (H, W) bool masks.
        device: where the network is.

    Returns:
        Means over the images; zeros when there is none.
    """
    was_training = network.training
    network.eval()
    scores = [score_heatmap(_probability(network, rgb, device), mask) for rgb, mask in pairs]
    network.train(was_training)
    return mean_score(scores) if scores else MaskScore(0.0, 0.0, 0)


@torch.inference_mode()
def _probability(network: nn.Module, rgb: np.ndarray, device: torch.device) -> np.ndarray:
    """Run the network on a (H, W, 3) uint8 image of any size."""
    height, width = rgb.shape[:2]
    image = torch.from_numpy(np.array(rgb)).to(device)  # a copy: torch wants to write
    image = image.permute(2, 0, 1)[None].float().div_(255)
    image = pad(image, (0, -width % 8, 0, -height % 8), mode="replicate")
    image = image.contiguous(memory_format=torch.channels_last)
    return torch.sigmoid(network(image)[0, 0, :height, :width].float()).cpu().numpy()
