"""Compare heat maps with known masks of images, and with labels computed from scaled images."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.errors import ImageError, OptionError
from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.progress import progress
from deepdetect.detector.detector import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions, compute_maps
from deepdetect.io.image import MINIMUM_SIDE, find_images, load_image, luma
from deepdetect.io.masks import load_mask

from ..datasets.scaling import scale_short_side
from ..labels import LabelOptions, fuse, visibility_of

EPSILON = 1e-7
"""Probabilities are clipped to this distance from 0 and 1, because log(0) is infinite."""

NUM_BINS = 20
"""Number of equally wide bins of probabilities for the calibration error. Chosen by hand."""


@dataclass(frozen=True)
class MaskScore:
    """How well heat maps agree with masks, over a set of images.

    Attributes:
        loss: binary cross-entropy per pixel (natural logarithm), mean over the images.
        iou: intersection over union of the mask and the heat map thresholded at 0.5, mean over the
            images. It is 1 for an image in which both are empty.
        images: number of images.
        calibration_error: expected calibration error (Naeini et al., 2015). Probabilities of all
            pixels are sorted into bins. For each bin, the mean probability is compared with the
            fraction of pixels that masks mark. The error is the mean absolute difference, in which
            a bin's weight is its number of pixels.
        density: fraction of the pixels of the images with a probability over 0.5 (keypoints).
        label_density: fraction of the pixels of the images that the masks mark.
    """

    loss: float
    iou: float
    images: int
    calibration_error: float
    density: float
    label_density: float


def score_heatmap(heatmap: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Return the loss and the IoU (see `MaskScore`) of (H, W) probabilities and an (H, W) mask."""
    probability = np.clip(heatmap.astype(np.float64), EPSILON, 1 - EPSILON)
    loss = -np.log(np.where(mask, probability, 1 - probability)).mean()
    predicted = heatmap > 0.5
    union = np.count_nonzero(predicted | mask)
    iou = np.count_nonzero(predicted & mask) / union if union else 1.0
    return float(loss), float(iou)


Measured = tuple[float, float, np.ndarray]
"""Measurements of an image: loss, IoU, and a (4, 20) array with a column for each bin of
probabilities. Its rows are the number of pixels in the bin, the sum of their probabilities, the
number of pixels that the mask marks, and the number with a probability over 0.5."""


def measure_heatmap(heatmap: np.ndarray, mask: np.ndarray) -> Measured:
    """Compare an (H, W) heat map with an (H, W) bool mask; `mean_score` combines the results."""
    probability = heatmap.astype(np.float64).ravel()
    bins = np.minimum((probability * NUM_BINS).astype(np.int64), NUM_BINS - 1)
    values = np.ones(len(bins)), probability, mask.ravel(), heatmap.ravel() > 0.5
    sums = np.array([np.bincount(bins, each, NUM_BINS) for each in values])
    return *score_heatmap(heatmap, mask), sums


def mean_score(measured: Sequence[Measured]) -> MaskScore:
    """Average the measurements of images: loss and IoU over images, other values over pixels."""
    loss = sum(loss for loss, _, _ in measured) / len(measured)
    iou = sum(iou for _, iou, _ in measured) / len(measured)
    pixels, probabilities, marked, predicted = np.sum([sums for *_, sums in measured], axis=0)
    count = pixels.sum()
    error = float(np.abs(probabilities - marked).sum() / count)
    densities = float(predicted.sum() / count), float(marked.sum() / count)
    return MaskScore(loss, iou, len(measured), error, *densities)


CERTAIN_LOGIT = 200.0
"""The sigmoid of this logit is exactly 1 in float32, and the sigmoid of its negative is 0."""


Sample = tuple[np.ndarray, np.ndarray, str]
"""An image, (H, W, 3) uint8 RGB, its mask, (H, W) bool, and its visibility, "normal" or "low"."""


def sample_images(folder: str | Path) -> list[Path]:
    """List the images `image_*.png` in a folder that also holds their masks `mask_image_*.png`.

    Raises:
        ImageError: there are no such images.
    """
    images = sorted(Path(folder).glob("image_*.png"))
    if not images:
        raise ImageError(
            f"there are no images with masks in {folder}: "
            "it must hold files image_NAME.png and mask_image_NAME.png"
        )
    return images


def load_sample(path: Path) -> Sample:
    """Load an image and the mask beside it.

    Raises:
        ImageError: a file is missing or damaged, or the mask has another size.
    """
    rgb = load_image(path)
    mask = load_mask(path.with_name(f"mask_{path.name}"))
    if mask.shape != rgb.shape[:2]:
        raise ImageError(f"the image {path} and its mask differ in size")
    return rgb, mask, visibility_of(luma(rgb))


def scaled_sample(image: Path | np.ndarray, scale: float) -> Sample:
    """Scale an image by a factor; its mask is the label that `fuse` makes of the scaled image.

    Raises:
        ImageError: the scaled image has a side of under 16 pixels.
    """
    rgb = load_image(image)
    if (side := round(scale * min(rgb.shape[:2]))) < MINIMUM_SIDE:
        raise ImageError(
            f"{image.name if isinstance(image, Path) else 'an image'} scaled by {scale:g} has a "
            f"side of {side} pixels, but at least {MINIMUM_SIDE} are needed: use larger scales"
        )
    rgb = scale_short_side(rgb, side)
    label = fuse(luma(rgb))
    return rgb, label.mask, label.visibility


def score_samples(
    heatmap: Callable[[np.ndarray], np.ndarray], samples: Iterable[Sample]
) -> dict[str, MaskScore]:
    """Compare a function's heat maps with the masks; return a score for each visibility."""
    measured: dict[str, list[Measured]] = {"normal": [], "low": []}
    for rgb, mask, visibility in samples:
        measured[visibility].append(measure_heatmap(heatmap(rgb), mask))
    return {name: mean_score(listed) for name, listed in measured.items() if listed}


@dataclass(frozen=True)
class Evaluation:
    """Scores of weights, as returned by `evaluate`.

    Attributes:
        masks: agreement of heat maps with known masks, by visibility ("normal" or "low").
        scales: agreement of the heat maps of scaled images with labels, by (scale, visibility).
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
    native = detector.configured(replace(detector.heatmap_options, resolution="native"))
    failures: dict[str, None] = {}
    with_masks = not scales or any(Path(samples).glob("mask_image_*.png"))
    images = sample_images(samples) if with_masks else find_images(samples)

    def loaded(title: str, load: Callable[[Path], Sample]) -> Iterator[Sample]:
        with progress(len(images), title, "image", quiet) as bar:
            for path in images:
                try:
                    yield load(path)
                except ImageError as error:
                    failures[str(error)] = None
                bar.update(1)

    masks = score_samples(detector.heatmap, loaded("scoring", load_sample)) if with_masks else {}
    by_scale: dict[tuple[float, str], MaskScore] = {}
    for scale in scales:
        scaled = loaded(f"scale {scale:g}", partial(scaled_sample, scale=scale))
        for visibility, score in score_samples(native.heatmap, scaled).items():
            by_scale[scale, visibility] = score
    if not masks and not by_scale:
        raise ImageError(next(iter(failures)))
    return Evaluation(masks, by_scale, tuple(failures))


class LabelDetector:
    """A detector without a network, whose keypoints are the pixels that the label of `fuse` marks.

    It behaves like weights that predict the label perfectly. With heat-map options the label is
    computed from the resized image that a network would get, otherwise from the original image.
    """

    def __init__(
        self, options: LabelOptions = LabelOptions(), heatmap_options: HeatmapOptions | None = None
    ) -> None:
        self.options = options
        self.heatmap_options = heatmap_options

    def heatmap(self, image: Any) -> np.ndarray:
        """Return the label as an (H, W) float32 map, 1 where it marks a pixel, otherwise 0."""
        rgb = load_image(image)
        if self.heatmap_options is not None:
            maps = compute_maps(rgb, self._network, self.heatmap_options)
            return maps.both()[0]
        return fuse(luma(rgb), self.options).mask.astype(np.float32)

    def _network(self, image: np.ndarray) -> np.ndarray:
        """Imitate a perfect network: map (1, 3, H, W) RGB in [0, 1] to (1, 1, H, W) logits."""
        rgb = np.rint(image[0].transpose(1, 2, 0) * 255).astype(np.uint8)
        mask = fuse(luma(rgb), self.options).mask[None, None]
        return np.where(mask, np.float32(CERTAIN_LOGIT), np.float32(-CERTAIN_LOGIT))


class LabelDensityDetector:
    """A detector that takes the most probable pixels, as many as the label of `fuse` marks.

    Weights that mark more pixels have a higher repeatability and more matches for this reason
    alone. With this detector, different weights are compared at equal numbers of keypoints.
    """

    def __init__(self, detector: DeepDetect) -> None:
        self.detector = detector
        seen = HeatmapOptions(detector.heatmap_options.resolution)  # no test-time augmentation
        self.labels = LabelDetector(heatmap_options=seen)

    def heatmap(self, image: Any) -> np.ndarray:
        """Return an (H, W) float32 map with 1 at the chosen pixels and 0 elsewhere."""
        rgb = load_image(image)
        count = int(np.count_nonzero(self.labels.heatmap(rgb) > 0.5))
        heatmap, logits = self.detector.heatmap_and_logits(rgb)
        taken = np.zeros(heatmap.size, np.float32)
        # If pixels have equal logits, those in upper rows are taken first.
        taken[np.argsort(-logits.ravel(), kind="stable")[:count]] = 1
        return taken.reshape(heatmap.shape)
