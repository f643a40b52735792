"""Whether weights keep their quality when an image is shown larger or smaller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .detector import DeepDetect
from .errors import OptionError
from .image import load_image, luma
from .labels import LabelOptions, fuse
from .mask_scores import MaskScore, mean_score, score_heatmap
from .training.views import scale_short_side


@dataclass(frozen=True)
class ScaleQuality:
    """What weights give at one scale.

    Attributes:
        scale: factor that the images were scaled by.
        visibility: of the images, "normal" or "low".
        score: against the labels of the scaled images.
        label_density: marked pixels of the labels a pixel, mean over images.
        density: keypoints a pixel at threshold 0.5, mean over images.
    """

    scale: float
    visibility: str
    score: MaskScore
    label_density: float
    density: float


def scale_quality(
    detector: DeepDetect,
    images: Sequence[Any],
    scales: Sequence[float],
    options: LabelOptions = LabelOptions(),
    done: Callable[[int], object] = lambda _: None,
) -> list[ScaleQuality]:
    """Score a detector on images scaled by several factors, each with labels of its own.

    Args:
        detector: its weights are measured, at native resolution.
        images: anything `load_image` takes.
        scales: factors above 0; images are shrunk by area averaging and enlarged cubically.
        options: how labels are made; the visibility of each image decides the settings.
        done: called with 1 after each image at each scale.

    Returns:
        A row for each scale and each visibility that occurs.

    Raises:
        OptionError: a scale is not above 0.
        ImageError: an image cannot be read, or is shrunk to under 16 pixels.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64, 3), np.uint8)
        >>> [row.scale for row in scale_quality(DeepDetect(), [image], (0.5, 1, 2))]
        [0.5, 1, 2]
    """
    if not all(scale > 0 for scale in scales):
        raise OptionError(f"scales must be above 0, not {min(scales):g}")
    rows = []
    for scale in scales:
        found: dict[str, list[tuple[MaskScore, float, float]]] = {}
        for image in images:
            rgb = load_image(image)
            scaled = scale_short_side(rgb, round(scale * min(rgb.shape[:2])))
            label = fuse(luma(load_image(scaled)), options)
            heatmap = detector.heatmap(scaled)
            found.setdefault(label.visibility, []).append(
                (
                    score_heatmap(heatmap, label.mask),
                    float(label.mask.mean()),
                    float((heatmap > 0.5).mean()),
                )
            )
            done(1)
        for visibility in sorted(found, reverse=True):
            scores, label_densities, densities = zip(*found[visibility], strict=True)
            rows.append(
                ScaleQuality(
                    scale,
                    visibility,
                    mean_score(scores),
                    float(np.mean(label_densities)),
                    float(np.mean(densities)),
                )
            )
    return rows
