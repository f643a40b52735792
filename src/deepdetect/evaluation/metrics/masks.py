"""How well heat maps fit true masks: cross-entropy, overlap and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

EPSILON = 1e-7
"""Probabilities are kept this far from 0 and 1: the next float32 under 1 is 6e-8 away."""

NUM_BINS = 20
"""Bins of equal width of the calibration error."""


@dataclass(frozen=True)
class MaskScore:
    """How well heat maps fit the masks of images.

    Attributes:
        loss: binary cross-entropy per pixel, natural logarithm; mean over the images.
        iou: intersection over union of the masks, the predicted one at threshold 0.5;
            1 where both are empty; mean over the images.
        images: number of images.
        calibration_error: the expected calibration error (Naeini et al., 2015) over all pixels:
            the mean difference, in the bin of a pixel, between probability and marked share.
        density: keypoints per pixel at the threshold 0.5.
        label_density: marked pixels per pixel.
    """

    loss: float
    iou: float
    images: int
    calibration_error: float
    density: float
    label_density: float


def score_heatmap(heatmap: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Return the loss and the IoU of a (H, W) probability against a (H, W) bool mask."""
    probability = np.clip(heatmap.astype(np.float64), EPSILON, 1 - EPSILON)
    loss = -np.log(np.where(mask, probability, 1 - probability)).mean()
    predicted = heatmap > 0.5
    union = np.count_nonzero(predicted | mask)
    iou = np.count_nonzero(predicted & mask) / union if union else 1.0
    return float(loss), float(iou)


Measured = tuple[float, float, np.ndarray]
"""Loss, IoU, and (4, 20) sums by bin: pixels, their probabilities, the marked, the predicted."""


def measure_heatmap(heatmap: np.ndarray, mask: np.ndarray) -> Measured:
    """Measure one image for `mean_score`."""
    probability = heatmap.astype(np.float64).ravel()
    bins = np.minimum((probability * NUM_BINS).astype(np.int64), NUM_BINS - 1)
    values = np.ones(len(bins)), probability, mask.ravel(), heatmap.ravel() > 0.5
    sums = np.array([np.bincount(bins, each, NUM_BINS) for each in values])
    return *score_heatmap(heatmap, mask), sums


def mean_score(measured: Sequence[Measured]) -> MaskScore:
    """Return the score of one or more images: losses by image, all others by pixel."""
    loss = sum(loss for loss, _, _ in measured) / len(measured)
    iou = sum(iou for _, iou, _ in measured) / len(measured)
    pixels, probabilities, marked, predicted = np.sum([sums for *_, sums in measured], axis=0)
    count = pixels.sum()
    error = float(np.abs(probabilities - marked).sum() / count)
    densities = float(predicted.sum() / count), float(marked.sum() / count)
    return MaskScore(loss, iou, len(measured), error, *densities)
