"""How well heat maps fit true masks: binary cross-entropy and intersection over union."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._shared.errors import ImageError
from .._shared.progress import progress
from ..io.image import load_image, luma
from ..io.masks import load_mask
from ..labels import visibility_of

EPSILON = 1e-7
"""Probabilities are kept so far from 0 and 1: the next float32 under 1 is 6e-8 away."""


@dataclass(frozen=True)
class MaskScore:
    """Means over images.

    Attributes:
        loss: binary cross-entropy a pixel, natural logarithm.
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


def score_samples(
    heatmap: Callable[[np.ndarray], np.ndarray], folder: str | Path, *, quiet: bool = True
) -> dict[str, MaskScore]:
    """Score a detector on a folder of samples `image_*.png` with masks `mask_image_*.png`.

    Args:
        heatmap: maps a (H, W, 3) uint8 RGB image to a (H, W) probability.
        folder: the samples.
        quiet: show no progress bar.

    Returns:
        The means by visibility, "normal" and "low", each as far as there are images.

    Raises:
        ImageError: there are no samples, or a mask is missing or of another size.
    """
    scores: dict[str, list[MaskScore]] = {"normal": [], "low": []}
    paths = sample_images(folder)
    with progress(len(paths), "scoring", "image", quiet) as bar:
        for path in paths:
            rgb = load_image(path)
            mask = load_mask(path.with_name(f"mask_{path.name}"))
            if mask.shape != rgb.shape[:2]:
                raise ImageError(f"the mask of {path} has another size than the image")
            scores[visibility_of(luma(rgb))].append(score_heatmap(heatmap(rgb), mask))
            bar.update(1)
    if not any(scores.values()):
        raise ImageError(
            f"there are no samples in {folder}: it must hold image_NAME.png and mask_image_NAME.png"
        )
    return {name: mean_score(listed) for name, listed in scores.items() if listed}


def sample_images(folder: str | Path) -> list[Path]:
    """List the images of a folder of samples."""
    return sorted(Path(folder).glob("image_*.png"))
