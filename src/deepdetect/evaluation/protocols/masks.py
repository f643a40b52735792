"""How well weights predict known masks, and the labels of images at several scales."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import ImageError, OptionError
from ...detector.detector import DeepDetect
from ...detector.heatmap import HeatmapOptions, compute_maps
from ...io.image import MINIMUM_SIDE, load_image, luma, scale_short_side
from ...io.masks import load_mask
from ...labels import LabelOptions, fuse, visibility_of
from ..metrics.calibration import Calibration, calibration_of, pooled
from ..metrics.masks import MaskScore, mean_score, score_heatmap

Scored = tuple[MaskScore, Calibration]


def sample_images(folder: str | Path) -> list[Path]:
    """List the images of a folder of samples `image_*.png` with masks `mask_image_*.png`.

    Raises:
        ImageError: there is none.
    """
    images = sorted(Path(folder).glob("image_*.png"))
    if not images:
        raise ImageError(
            f"there are no samples in {folder}: it must hold image_NAME.png and mask_image_NAME.png"
        )
    return images


def has_samples(folder: str | Path) -> bool:
    """Whether a folder holds an image `image_*.png` with a mask, not photographs alone."""
    return any(True for _ in Path(folder).glob("mask_image_*.png"))


def score_samples(
    heatmap: Callable[[np.ndarray], np.ndarray], images: Iterable[Path]
) -> dict[str, Scored]:
    """Score a detector on samples with known masks.

    Args:
        heatmap: maps a (H, W, 3) uint8 RGB image to a (H, W) probability.
        images: of `sample_images`.

    Returns:
        By visibility, "normal" and "low", where there are images of it: the means over the images,
        and the calibration over all their pixels.

    Raises:
        ImageError: a mask is missing or of another size.
    """

    def scored() -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        for path in images:
            rgb, mask = load_sample(path)
            yield visibility_of(luma(rgb)), heatmap(rgb), mask

    return _over_images(scored())


def _over_images(images: Iterable[tuple[str, np.ndarray, np.ndarray]]) -> dict[str, Scored]:
    """Score visibilities with heat maps and masks: the means, and all pixels, by visibility."""
    scores: dict[str, list[Scored]] = {"normal": [], "low": []}
    for visibility, heatmap, mask in images:
        scores[visibility].append((score_heatmap(heatmap, mask), calibration_of(heatmap, mask)))
    return {
        name: (mean_score(score for score, _ in listed), pooled(found for _, found in listed))
        for name, listed in scores.items()
        if listed
    }


def load_sample(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Load a sample: (H, W, 3) uint8 RGB, and its known mask, (H, W) bool.

    Raises:
        ImageError: one of them is missing or damaged, or the mask is of another size.
    """
    rgb = load_image(path)
    mask = load_mask(path.with_name(f"mask_{path.name}"))
    if mask.shape != rgb.shape[:2]:
        raise ImageError(f"the mask of {path} has another size than the image")
    return rgb, mask


def readable_images(
    images: Iterable[Path], load: Callable[[Path], object] = load_image
) -> tuple[list[Path], tuple[str, ...]]:
    """Return the images that can be loaded, and a sentence on each of the others.

    Args:
        images: their files.
        load: `load_sample` for samples, which need a mask.

    Raises:
        ImageError: there is none that can be loaded.
    """
    whole: list[Path] = []
    failures: list[str] = []
    for path in images:
        try:
            load(path)
            whole.append(path)
        except ImageError as error:
            failures.append(str(error))
    if not whole:
        raise ImageError(failures[0])
    return whole, tuple(failures)


CERTAIN_LOGIT = 200.0
"""Float32 rounds its probability to 1, and that of its negative to 0."""


class LabelDetector:
    """A detector whose keypoints are the fusion label itself, without a network.

    Its numbers are those of weights without any error: they say how much of a metric learning the
    labels better can give. Weights that exceed them do so by their errors.

    Args:
        options: how labels are made.
        heatmap_options: the image is labelled as a network with these options sees it; default the
            image as it is.

    Example:
        >>> image = np.zeros((32, 32), np.uint8)
        >>> image[8:24, 8:24] = 255
        >>> float(LabelDetector().heatmap(image)[8, 8])
        1.0
    """

    def __init__(
        self,
        options: LabelOptions = LabelOptions(),
        heatmap_options: HeatmapOptions | None = None,
    ) -> None:
        self.options = options
        self.heatmap_options = heatmap_options

    def heatmap(self, image: Any) -> np.ndarray:
        """Return the label as (H, W) float32, 0 or 1."""
        rgb = load_image(image)
        if self.heatmap_options is not None:
            return compute_maps(rgb, self._network, self.heatmap_options).both()[0]
        return fuse(luma(rgb), self.options).mask.astype(np.float32)

    def _network(self, image: np.ndarray) -> np.ndarray:
        """Do what the network is trained for: (1, 3, H, W) RGB in [0, 1] to (1, 1, H, W) logits."""
        rgb = np.rint(image[0].transpose(1, 2, 0) * 255).astype(np.uint8)
        mask = fuse(luma(rgb), self.options).mask[None, None]
        return np.where(mask, np.float32(CERTAIN_LOGIT), np.float32(-CERTAIN_LOGIT))


class LabelDensityDetector:
    """A detector that takes the most probable pixels of each image, as many as its label marks.

    Weights that mark more have more repeatable keypoints and more matches for that alone. With this
    detector all are compared at the same number of keypoints.

    Args:
        detector: with the weights and the resolution.
        options: how labels are made; each image is labelled as the network sees it.

    Example:
        >>> image = np.zeros((64, 64), np.uint8)
        >>> image[16:48, 16:48] = 255
        >>> taken = LabelDensityDetector(DeepDetect()).heatmap(image)
        >>> bool(taken.sum() == LabelDetector().heatmap(image).sum())
        True
    """

    def __init__(self, detector: DeepDetect, options: LabelOptions = LabelOptions()) -> None:
        self.detector = detector
        seen = HeatmapOptions(detector.heatmap_options.resolution)  # labels are not flipped
        self.labels = LabelDetector(options, seen)

    def heatmap(self, image: Any) -> np.ndarray:
        """Return (H, W) float32: 1 at the pixels that are taken, else 0."""
        rgb = load_image(image)
        count = int(np.count_nonzero(self.labels.heatmap(rgb) > 0.5))
        heatmap, logits = self.detector.heatmap_and_logits(rgb)
        taken = np.zeros(heatmap.size, np.float32)
        # Of equal ones the first in the order of rows.
        taken[np.argsort(-logits.ravel(), kind="stable")[:count]] = 1
        return taken.reshape(heatmap.shape)


@dataclass(frozen=True)
class ScaleScore:
    """What weights give at one scale.

    Attributes:
        scale: factor that the images were scaled by.
        visibility: of the images, "normal" or "low".
        score: against the labels of the scaled images.
        calibration: over all their pixels.
    """

    scale: float
    visibility: str
    score: MaskScore
    calibration: Calibration

    @property
    def label_density(self) -> float:
        """Marked pixels of the labels per pixel."""
        return self.calibration.label_density

    @property
    def density(self) -> float:
        """Keypoints per pixel at threshold 0.5."""
        return self.calibration.density


def check_scales(scales: Sequence[float]) -> None:
    """Make sure that images can be scaled by these factors.

    Raises:
        OptionError: one is not above 0, or not finite.
    """
    for scale in scales:
        if not (math.isfinite(scale) and scale > 0):
            raise OptionError(f"a scale must be a number above 0, not {scale:g}")


def score_at_scale(
    detector: DeepDetect,
    images: Iterable[Any],
    scale: float,
    options: LabelOptions = LabelOptions(),
) -> list[ScaleScore]:
    """Score a detector on images scaled by a factor, against the labels of the scaled images.

    Args:
        detector: its weights are measured, at native resolution, whatever theirs is; its other
            options stay.
        images: anything `load_image` takes.
        scale: above 0; images are downscaled by area averaging and upscaled cubically.
        options: how labels are made; the visibility of each image decides the settings.

    Returns:
        A row for each visibility that occurs.

    Raises:
        OptionError: the scale is not above 0.
        ImageError: an image cannot be read, or is downscaled to under 16 pixels.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64, 3), np.uint8)
        >>> (row,) = score_at_scale(DeepDetect(), [image], 0.5)
        >>> row.visibility, row.label_density  # noise has structure everywhere
        ('normal', 1.0)
    """
    check_scales([scale])
    native = detector.configured(replace(detector.heatmap_options, resolution="native"))

    def scored() -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        for image in images:
            rgb = _scaled(load_image(image), scale)
            label = fuse(luma(rgb), options)
            yield label.visibility, native.heatmap(rgb), label.mask

    return [ScaleScore(scale, name, *found) for name, found in _over_images(scored()).items()]


def _scaled(rgb: np.ndarray, scale: float) -> np.ndarray:
    short_side = round(scale * min(rgb.shape[:2]))
    if short_side < MINIMUM_SIDE:
        raise ImageError(
            f"an image scaled by {scale:g} has a side of {short_side} pixels: "
            f"it needs at least {MINIMUM_SIDE}, use larger scales"
        )
    return scale_short_side(rgb, short_side)
