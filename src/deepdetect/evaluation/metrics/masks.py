"""How well heat maps fit true masks: binary cross-entropy and intersection over union."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..._shared.errors import ImageError

EPSILON = 1e-7
"""Probabilities are kept this far from 0 and 1: the next float32 under 1 is 6e-8 away."""


@dataclass(frozen=True)
class MaskScore:
    """Means over images.

    Attributes:
        loss: binary cross-entropy per pixel, natural logarithm.
        iou: intersection over union of the masks, the predicted one at threshold 0.5;
            1 where both are empty.
        images: number of images.
    """

    loss: float
    iou: float
    images: int


def score_heatmap(heatmap: np.ndarray, mask: np.ndarray) -> MaskScore:
    """Score one heat map.

    Args:
        heatmap: (H, W) float32 probability.
        mask: (H, W) bool truth.

    Example:
        >>> score_heatmap(np.full((2, 2), 0.5), np.ones((2, 2), bool)).loss  # ln 2
        0.6931471805599453
    """
    probability = np.clip(heatmap.astype(np.float64), EPSILON, 1 - EPSILON)
    loss = -np.log(np.where(mask, probability, 1 - probability)).mean()
    predicted = heatmap > 0.5
    union = np.count_nonzero(predicted | mask)
    iou = np.count_nonzero(predicted & mask) / union if union else 1.0
    return MaskScore(float(loss), float(iou), 1)


def mean_score(scores: Iterable[MaskScore]) -> MaskScore:
    """Average scores, each image counting the same.

    Raises:
        ImageError: there is none.
    """
    listed = list(scores)
    images = sum(score.images for score in listed)
    if not images:
        raise ImageError("there is no image to score: check the folder")
    return MaskScore(
        sum(score.loss * score.images for score in listed) / images,
        sum(score.iou * score.images for score in listed) / images,
        images,
    )
