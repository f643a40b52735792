"""How well heat maps fit known masks, and the labels of images at several scales."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.errors import ImageError
from deepdetect.detector.detector import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions, compute_maps
from deepdetect.io.image import MINIMUM_SIDE, load_image, luma, scale_short_side
from deepdetect.io.masks import load_mask

from ...labels import LabelOptions, fuse, visibility_of

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


CERTAIN_LOGIT = 200.0
"""Float32 rounds its probability to 1, and that of its negative to 0."""


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


def score_samples(
    heatmap: Callable[[np.ndarray], np.ndarray], samples: Iterable[tuple[np.ndarray, np.ndarray]]
) -> dict[str, MaskScore]:
    """Score what maps an image to a heat map on samples of `load_sample`, by visibility."""
    return _by_visibility(
        (visibility_of(luma(rgb)), measure_heatmap(heatmap(rgb), mask)) for rgb, mask in samples
    )


def _by_visibility(images: Iterable[tuple[str, Measured]]) -> dict[str, MaskScore]:
    """Score the images of each visibility, "normal" and "low", of which there are any."""
    measured: dict[str, list[Measured]] = {"normal": [], "low": []}
    for visibility, one in images:
        measured[visibility].append(one)
    return {name: mean_score(listed) for name, listed in measured.items() if listed}


def check_scale(image: np.ndarray, scale: float, name: str = "an image") -> None:
    """Raise an ImageError where an image is downscaled to under 16 pixels."""
    if (side := round(scale * min(image.shape[:2]))) < MINIMUM_SIDE:
        raise ImageError(
            f"{name} scaled by {scale:g} has a side of {side} pixels: "
            f"it needs at least {MINIMUM_SIDE}, use larger scales"
        )


def score_at_scale(
    detector: DeepDetect, images: Iterable[np.ndarray], scale: float
) -> dict[str, MaskScore]:
    """Score weights on (H, W, 3) images scaled by a factor, against labels of their own.

    At native resolution; images are downscaled by area averaging and upscaled cubically. The
    visibility of each image decides how it is labelled.

    Raises:
        ImageError: an image is downscaled to under 16 pixels.
    """
    native = detector.configured(replace(detector.heatmap_options, resolution="native"))

    def measured() -> Iterator[tuple[str, Measured]]:
        for image in images:
            check_scale(image, scale)
            rgb = scale_short_side(image, round(scale * min(image.shape[:2])))
            label = fuse(luma(rgb))
            yield label.visibility, measure_heatmap(native.heatmap(rgb), label.mask)

    return _by_visibility(measured())


class LabelDetector:
    """A detector whose keypoints are the fusion label itself, without a network.

    Its numbers are those of weights without any error: weights that exceed them do so by their
    errors. The image is labelled as a network with the heatmap options sees it, or as it is.
    """

    def __init__(
        self, options: LabelOptions = LabelOptions(), heatmap_options: HeatmapOptions | None = None
    ) -> None:
        self.options = options
        self.heatmap_options = heatmap_options

    def heatmap(self, image: Any) -> np.ndarray:
        """Return the label as (H, W) float32, 0 or 1."""
        rgb = load_image(image)
        if self.heatmap_options is not None:
            maps = compute_maps(rgb, self._network, self.heatmap_options)
            return maps.both()[0]
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
    """

    def __init__(self, detector: DeepDetect) -> None:
        self.detector = detector
        seen = HeatmapOptions(detector.heatmap_options.resolution)  # labels are not flipped
        self.labels = LabelDetector(heatmap_options=seen)

    def heatmap(self, image: Any) -> np.ndarray:
        """Return (H, W) float32: 1 at the pixels that are taken, else 0."""
        rgb = load_image(image)
        count = int(np.count_nonzero(self.labels.heatmap(rgb) > 0.5))
        heatmap, logits = self.detector.heatmap_and_logits(rgb)
        taken = np.zeros(heatmap.size, np.float32)
        # Of equal ones the first in the order of rows.
        taken[np.argsort(-logits.ravel(), kind="stable")[:count]] = 1
        return taken.reshape(heatmap.shape)
