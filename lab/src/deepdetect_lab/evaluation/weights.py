"""Evaluate weights by known masks, and by labels of scaled images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from deepdetect._shared.errors import ImageError, OptionError
from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.progress import progress
from deepdetect.detector.detector import DeepDetect
from deepdetect.io.image import find_images, load_image

from .protocols.masks import (
    MaskScore,
    check_scale,
    load_sample,
    sample_images,
    score_at_scale,
    score_samples,
)


@dataclass(frozen=True)
class Evaluation:
    """Scores of weights, as returned by `evaluate`.

    Attributes:
        masks: agreement of heat maps with known masks, by visibility ("normal" or "low").
        scales: agreement of scaled images' heat maps with their labels, by (scale, visibility).
        failures: a sentence for each unusable sample, which the scores leave out.
    """

    masks: dict[str, MaskScore]
    scales: dict[tuple[float, str], MaskScore]
    failures: tuple[str, ...] = ()


@suggest_keywords
def evaluate(
    samples: str | Path,
    detector: DeepDetect | None = None,
    *,
    scales: Sequence[float] = (),
    quiet: bool = True,
) -> Evaluation:
    """Compare the heat maps of images with masks or labels.

    Args:
        samples: folder of images `image_NAME.png` with known masks `mask_image_NAME.png`. If
            `scales` are given, it may also be a folder of any images without masks.
        detector: DeepDetect with the weights; default `DeepDetect()`. For known masks it keeps its
            own resolution. Scaled images are processed at their size.
        scales: factors above 0, by which the images are scaled. Heat maps of scaled images are
            compared with labels that are computed from the scaled images.
        quiet: show no progress bars.

    Raises:
        ImageError: no image can be read, or all masks are missing.
        OptionError: a scale is not above 0.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from PIL import Image
        >>> folder = Path(tempfile.mkdtemp())
        >>> for name in ("image_1.png", "mask_image_1.png"):
        ...     Image.fromarray(np.zeros((64, 64), np.uint8)).save(folder / name)
        >>> list(evaluate(folder).masks)
        ['low']
    """
    if not all(0 < scale < math.inf for scale in scales):
        raise OptionError(f"scales must be numbers above 0, not {list(scales)}")
    detector = DeepDetect() if detector is None else detector
    failures: dict[str, None] = {}
    with_masks = not scales or any(Path(samples).glob("mask_image_*.png"))
    images = sample_images(samples) if with_masks else find_images(samples)

    def loaded(title: str, scale: float = 1) -> Iterator[tuple[Any, Any]]:
        with progress(len(images), title, "image", quiet) as bar:
            for path in images:
                try:
                    sample = load_sample(path) if with_masks else (load_image(path), None)
                    check_scale(sample[0], scale, path.name)
                    yield sample
                except ImageError as error:
                    failures[str(error)] = None
                bar.update(1)

    masks = score_samples(detector.heatmap, loaded("scoring")) if with_masks else {}
    by_scale: dict[tuple[float, str], MaskScore] = {}
    for scale in scales:
        shown = (rgb for rgb, _ in loaded(f"scale {scale:g}", scale))
        for visibility, score in score_at_scale(detector, shown, scale).items():
            by_scale[scale, visibility] = score
    if not masks and not by_scale:
        raise ImageError(next(iter(failures)))
    return Evaluation(masks, by_scale, tuple(failures))
