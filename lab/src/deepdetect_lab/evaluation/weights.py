"""Evaluate weights by known masks, by labels of scaled images, and by the paper's protocol."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from deepdetect._shared.errors import ImageError, OptionError
from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.progress import progress
from deepdetect.detector.detector import DeepDetect
from deepdetect.features.selection import SelectionOptions
from deepdetect.io.image import find_images, load_image

from ..datasets.foreground import MaskedPhotograph, load_foreground
from ..datasets.planar import PlanarPair, PlanarScene, load_oxford
from .baselines.method import LocalFeature, deepdetect_feature
from .options import PAPER_RESOLUTION_PX, THRESHOLDS
from .protocols.masks import (
    LabelDensityDetector,
    MaskScore,
    check_scale,
    load_sample,
    sample_images,
    score_at_scale,
    score_samples,
)
from .protocols.paper import OXFORD_PAIRS, foreground_rows, mean_correct_matches, repeatability_rows
from .protocols.planar import select_pairs
from .report import Row, mean, where
from .run import Run


@dataclass(frozen=True)
class OxfordScore:
    """Scores of weights on the Oxford scenes, with RGB images resized to 480x480.

    Attributes:
        density: for each of the paper's thresholds, the number of keypoints per pixel, mean over
            all images. If `equal_density` is set, only the first threshold is used.
        repeatability: the paper's repeatability of each scene, mean over its five pairs.
        correct: for each pair, the number of matches (FLANN, ratio 0.99) with an error under 1 px
            by the published homography, mean over several seeds of FLANN.
        matches: for each pair, the number of all matches, mean over the same seeds.
        failures: a sentence for each image or pair that failed. The means leave these out.
    """

    density: dict[float, float]
    repeatability: dict[str, float]
    correct: dict[str, int]
    matches: dict[str, int]
    failures: tuple[str, ...] = ()


@dataclass(frozen=True)
class ForegroundScore:
    """How many keypoints are on the foreground of photographs, which are resized to 480x480.

    Attributes:
        fraction: fraction of the keypoints on the foreground, mean over the photographs.
        density: keypoints per pixel, mean over the photographs.
        covered: fraction of pixels on the foreground. Random keypoints would have this `fraction`.
        photographs: number of photographs with a keypoint. The means leave out the others.
        failures: a sentence for each photograph that could not be measured.
    """

    fraction: float
    density: float
    covered: float
    photographs: int
    failures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Evaluation:
    """Scores of weights, as returned by `evaluate`.

    Attributes:
        masks: agreement of heat maps with known masks, by visibility ("normal" or "low").
        scales: agreement of scaled images' heat maps with their labels, by (scale, visibility).
        oxford: scores by the paper's protocol on the Oxford scenes.
        foreground: scores on photographs with a known foreground.
        failures: a sentence for each unusable sample, which `masks` and `scales` leave out.
    """

    masks: dict[str, MaskScore] = field(default_factory=dict)
    scales: dict[tuple[float, str], MaskScore] = field(default_factory=dict)
    oxford: OxfordScore | None = None
    foreground: ForegroundScore | None = None
    failures: tuple[str, ...] = ()


@suggest_keywords
def evaluate(
    detector: DeepDetect | None = None,
    *,
    samples: str | Path | None = None,
    scales: Sequence[float] = (),
    oxford: str | Path | None = None,
    foreground: str | Path | None = None,
    equal_density: bool = False,
    quiet: bool = True,
) -> Evaluation:
    """Evaluate weights of DeepDetect by each kind of data that is given.

    Args:
        detector: DeepDetect with the weights; default `DeepDetect()`. For known masks it keeps its
            own resolution. Scaled images are processed at their size, and images of `oxford` and
            `foreground` are resized to 480x480.
        samples: folder of images `image_NAME.png` with known masks `mask_image_NAME.png`. If
            `scales` are given, it may also be a folder of any images without masks.
        scales: factors above 0, by which the images in `samples` are scaled. Heat maps of scaled
            images are compared with labels that are computed from the scaled images.
        oxford: folder of the eight Oxford scenes, for which repeatability and matches are measured.
        foreground: folder of photographs NAME.jpg with their foreground NAME_mask.png, for which
            the fraction of the keypoints on the foreground is measured.
        equal_density: in each image of `oxford` and `foreground`, take the N most probable pixels
            as keypoints, instead of all above 0.5. N is the number of pixels that the image's
            fusion label marks. Otherwise weights with more keypoints would score higher.
        quiet: show no progress bars.

    Raises:
        ImageError: no sample, scene or photograph can be read, or a file of one is missing.
        OptionError: a scale is not above 0, `scales` is given without `samples`, or `equal_density`
            without `oxford` or `foreground`.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> from PIL import Image
        >>> folder = Path(tempfile.mkdtemp())
        >>> for name in ("image_1.png", "mask_image_1.png"):
        ...     Image.fromarray(np.zeros((64, 64), np.uint8)).save(folder / name)
        >>> list(evaluate(samples=folder).masks)
        ['low']
    """
    if not all(0 < scale < math.inf for scale in scales):
        raise OptionError(f"scales must be numbers above 0, not {list(scales)}")
    if scales and samples is None:
        raise OptionError("`scales` needs images to scale: also name their folder as `samples`")
    if equal_density and oxford is None and foreground is None:
        raise OptionError(
            "`equal_density` only affects `oxford` and `foreground`: also name one of these folders"
        )
    scenes = None if oxford is None else load_oxford(oxford)
    masked = None if foreground is None else load_foreground(foreground)
    detector = DeepDetect() if detector is None else detector
    masks: dict[str, MaskScore] = {}
    by_scale: dict[tuple[float, str], MaskScore] = {}
    failures: dict[str, None] = {}
    if samples is not None:
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

        if with_masks:
            masks = score_samples(detector.heatmap, loaded("scoring"))
        for scale in scales:
            shown = (rgb for rgb, _ in loaded(f"scale {scale:g}", scale))
            for visibility, score in score_at_scale(detector, shown, scale).items():
                by_scale[scale, visibility] = score
        if not masks and not by_scale:
            raise ImageError(next(iter(failures)))
    how = {"equal_density": equal_density, "quiet": quiet}
    return Evaluation(
        masks,
        by_scale,
        None if scenes is None else evaluate_oxford(detector, scenes, **how),
        None if masked is None else evaluate_foreground(detector, masked, **how),
        tuple(failures),
    )


def evaluate_oxford(
    detector: Any, scenes: list[PlanarScene], *, equal_density: bool = False, quiet: bool = True
) -> OxfordScore:
    """Evaluate weights, or any detector with a method `heatmap`, on scenes from `load_oxford`.

    A DeepDetect gets images resized to 480x480. `equal_density` is as in `evaluate`.
    """
    detector = _of_paper(detector, equal_density)
    features = [_feature(detector)]
    thresholds = THRESHOLDS[:1] if equal_density else THRESHOLDS
    run = Run(Path(), quiet=quiet)

    def densities(_: LocalFeature, image: Path) -> Row:
        heatmap = detector.heatmap(load_image(image))
        return {t: float((heatmap > t).mean()) for t in thresholds}

    def matches(feature: LocalFeature, pair: PlanarPair) -> Row:
        correct, every = mean_correct_matches(run, feature, pair)
        return {"correct": correct, "all": every}

    images = {f"{scene.name}/{path.name}": path for scene in scenes for path in scene.images}
    matched = {pair.name: pair for pair in select_pairs(scenes, OXFORD_PAIRS)}
    density = run.rows("density of ", features, images, densities)
    repeated = repeatability_rows(run, features, scenes)
    counts = run.rows("matches of ", features, matched, matches)
    if run.failures and not density:
        raise ImageError(run.failures[0])
    return OxfordScore(
        {t: mean(density, t) or 0.0 for t in thresholds},
        {
            scene: mean(where(repeated, scene=scene), "repeatability") or 0.0
            for scene in dict.fromkeys(row["scene"] for row in repeated)
        },
        {row["item"]: row["correct"] for row in counts},
        {row["item"]: row["all"] for row in counts},
        tuple(run.failures),
    )


def evaluate_foreground(
    detector: Any,
    images: Sequence[MaskedPhotograph],
    *,
    equal_density: bool = False,
    quiet: bool = True,
) -> ForegroundScore:
    """Measure the fraction of keypoints on the foreground. Options are as in `evaluate_oxford`."""
    run = Run(Path(), quiet=quiet)
    rows = foreground_rows(run, [_feature(_of_paper(detector, equal_density))], images)
    known = [row for row in rows if row["density"] > 0]
    if run.failures and not rows:
        raise ImageError(run.failures[0])
    if not known:
        raise ImageError("the detector finds no keypoint in any photograph with a foreground mask")
    fraction, density, covered = (mean(known, n) or 0.0 for n in ("fraction", "density", "covered"))
    return ForegroundScore(fraction, density, covered, len(known), tuple(run.failures))


def _of_paper(detector: Any, equal_density: bool) -> Any:
    """Return a copy of a DeepDetect that resizes images to 480x480; return others unchanged."""
    if not isinstance(detector, DeepDetect):
        return detector
    options = replace(
        detector.heatmap_options, resolution=PAPER_RESOLUTION_PX, tile_megapixels="auto"
    )
    squashing = detector.configured(options)
    return LabelDensityDetector(squashing) if equal_density else squashing


def _feature(detector: Any) -> LocalFeature:
    selection = SelectionOptions(THRESHOLDS[0])
    title = "the weights"
    return deepdetect_feature(detector, selection, name="evaluated", title=title, version="1")
