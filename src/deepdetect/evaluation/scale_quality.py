"""Whether weights keep their quality when an image is shown larger or smaller."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .._shared.errors import ImageError, OptionError
from ..detector.detector import DeepDetect
from ..detector.heatmap import HeatmapOptions
from ..io.image import MINIMUM_SIDE, load_image, luma, scale_short_side
from ..labels import LabelOptions, fuse
from .mask_scores import MaskScore, mean_score, score_heatmap


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


def check_scales(scales: Sequence[float]) -> None:
    """Make sure that images can be scaled by these factors.

    Raises:
        OptionError: one is not above 0, or not finite.
    """
    for scale in scales:
        if not (math.isfinite(scale) and scale > 0):
            raise OptionError(f"a scale must be a number above 0, not {scale:g}")


def scale_quality(
    detectors: Sequence[DeepDetect],
    images: Sequence[Any],
    scales: Sequence[float],
    options: LabelOptions = LabelOptions(),
    done: Callable[[int], object] = lambda _: None,
) -> list[list[ScaleQuality]]:
    """Score detectors on images scaled by several factors, each with labels of its own.

    Args:
        detectors: their weights are measured, at native resolution, whatever theirs is.
        images: anything `load_image` takes.
        scales: factors above 0; images are shrunk by area averaging and enlarged cubically.
        options: how labels are made; the visibility of each image decides the settings.
        done: called with 1 after each image at each scale.

    Returns:
        For each detector a row for each scale and each visibility that occurs.

    Raises:
        OptionError: a scale is not above 0.
        ImageError: an image cannot be read, or is shrunk to under 16 pixels.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64, 3), np.uint8)
        >>> (rows,) = scale_quality([DeepDetect()], [image], (0.5, 1, 2))
        >>> [row.scale for row in rows]
        [0.5, 1, 2]
    """
    check_scales(scales)
    native = [detector.configured(HeatmapOptions()) for detector in detectors]
    rows: list[list[ScaleQuality]] = [[] for _ in detectors]
    for scale in scales:
        found: dict[str, list[tuple[float, list[tuple[MaskScore, float]]]]] = {}
        for image in images:
            scaled = _scaled(load_image(image), scale)
            label = fuse(luma(scaled), options)
            heatmaps = [detector.heatmap(scaled) for detector in native]
            scores = [(score_heatmap(h, label.mask), float((h > 0.5).mean())) for h in heatmaps]
            found.setdefault(label.visibility, []).append((float(label.mask.mean()), scores))
            done(1)
        for visibility in sorted(found, reverse=True):
            label_density = float(np.mean([density for density, _ in found[visibility]]))
            for k, own in enumerate(rows):
                mine = [scores[k] for _, scores in found[visibility]]
                score = mean_score(score for score, _ in mine)
                density = float(np.mean([density for _, density in mine]))
                own.append(ScaleQuality(scale, visibility, score, label_density, density))
    return rows


def _scaled(rgb: np.ndarray, scale: float) -> np.ndarray:
    short_side = round(scale * min(rgb.shape[:2]))
    if short_side < MINIMUM_SIDE:
        raise ImageError(
            f"an image scaled by {scale:g} has a side of {short_side} pixels: "
            f"it needs at least {MINIMUM_SIDE}, use larger scales"
        )
    return scale_short_side(rgb, short_side)
