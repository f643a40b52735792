"""How good weights are, by the measures of the paper: known masks, and the Oxford scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..datasets.oxford import find_scene
from ..datasets.types import PlanarPair, PlanarScene
from ..detector.detector import DeepDetect, HeatmapDetector
from ..detector.heatmap import HeatmapOptions, compute_heatmap
from ..features.keypoints import Keypoints
from ..features.matchers import get_matcher, match_descriptors
from ..features.selection import SelectionOptions, select_keypoints
from ..features.sift import get_descriptor
from ..geometry.residuals import transfer_errors
from ..io.image import load_image, luma
from ..labels import fuse
from ..matching.options import get_preset
from .metrics import published_repeatability

THRESHOLDS = (0.5, 0.7, 0.8, 0.9)
PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    ("boat", 2),
)
"""The pairs of the paper's Table II: scene, and number of the second image."""

RESOLUTION = 480
CORRECT = 1.0  # pixels, strictly under
SEEDS = 3
"""FLANN's trees are random, and counts of one seed differ by some per cent: means are told."""

FEW = 1000
MANY_SEEDS = 64
"""So few correct matches (graf's are a hundred) differ by a tenth from seed to seed."""


@dataclass(frozen=True)
class OxfordQuality:
    """What weights give on the Oxford scenes, images squashed to 480x480 and RGB.

    Attributes:
        density: keypoints a pixel at each of `THRESHOLDS`, mean over all images.
        repeatability: by scene, mean over its five pairs, as published, clipped.
        correct: correct matches (FLANN, ratio 0.99, under 1 px by the published
            homography) by pair, mean of `SEEDS` seeds of FLANN, of `MANY_SEEDS` where they are
            fewer than `FEW`.
        matches: all matches that pass the ratio test, likewise.
    """

    density: dict[float, float]
    repeatability: dict[str, float]
    correct: dict[str, int]
    matches: dict[str, int]


class LabelMasks:
    """What weights without any error would predict: the label of the image as they see it.

    Its numbers say how much of a measure learning the labels better can give: weights that are
    above them are so by their errors.

    Example:
        >>> image = np.zeros((480, 480, 3), np.uint8)
        >>> image[100:200, 100:200] = 255
        >>> sorted(set(LabelMasks().heatmap(image).ravel().tolist()))
        [0.0, 1.0]
    """

    def heatmap(self, image: Any) -> np.ndarray:
        """Map an image to the (H, W) float32 mask of its label at 480x480, enlarged again."""
        return compute_heatmap(load_image(image), _label_network, HeatmapOptions(RESOLUTION))


def _label_network(planes: np.ndarray) -> np.ndarray:
    """Do what the network is trained for: (1, 3, H, W) RGB in [0, 1] to (1, 1, H, W)."""
    rgb = np.rint(planes[0].transpose(1, 2, 0) * 255).astype(np.uint8)
    marks = fuse(luma(rgb)).mask[None, None].astype(np.float32)
    return np.where(marks > 0, np.inf, -np.inf).astype(np.float32)


def oxford_quality(
    detector: DeepDetect | LabelMasks,
    scenes: list[PlanarScene],
    done: Callable[[int], object] = lambda _: None,
) -> OxfordQuality:
    """Measure weights, or the labels themselves, on the Oxford scenes.

    Args:
        detector: its weights are measured; its own resolution is not used.
        scenes: of `load_oxford`.
        done: called with 1 after each of `oxford_steps` steps.
    """
    squashing: HeatmapDetector = detector
    if isinstance(detector, DeepDetect):
        squashing = detector.configured(HeatmapOptions(RESOLUTION))
    densities: dict[float, list[float]] = {threshold: [] for threshold in THRESHOLDS}
    repeatability = {}
    for scene in scenes:
        points = []
        for path in scene.images:
            heatmap = squashing.heatmap(load_image(path))
            for threshold in THRESHOLDS:
                densities[threshold].append(float((heatmap > threshold).mean()))
            points.append(select_keypoints(heatmap, SelectionOptions()))
            done(1)
        repeatability[scene.name] = _scene_repeatability(scene, points)
    correct, matches = {}, {}
    for name, number in PAIRS:
        pair = list(find_scene(scenes, name).pairs())[number - 2]
        correct[pair.name], matches[pair.name] = count_correct(squashing, pair)
        done(1)
    density = {threshold: float(np.mean(found)) for threshold, found in densities.items()}
    return OxfordQuality(density, repeatability, correct, matches)


def oxford_steps(scenes: list[PlanarScene]) -> int:
    """Return how often `oxford_quality` calls `done`."""
    return sum(len(scene.images) for scene in scenes) + len(PAIRS)


def _scene_repeatability(scene: PlanarScene, points: list[Keypoints]) -> float:
    values = [
        published_repeatability(points[0].xy, points[pair.number - 1].xy, pair.homography)
        for pair in scene.pairs()
    ]
    return float(np.mean(values))


def count_correct(detector: HeatmapDetector, pair: PlanarPair) -> tuple[int, int]:
    """Match a pair the paper's way, but with the channels in the order of the training.

    Args:
        detector: shows the network squashed images.
        pair: the images and their homography.

    Returns:
        The number of correct matches, and of all; means of the seeds, rounded.
    """
    chosen = get_preset("published")
    rgb = load_image(pair.first), load_image(pair.second)
    points = [select_keypoints(detector.heatmap(image), chosen.selection).xy for image in rgb]
    describe, matcher = get_descriptor(chosen.descriptor), get_matcher(chosen.matcher)
    descriptors = [
        describe(luma(image), xy, chosen.keypoint_size, chosen.angle)
        for image, xy in zip(rgb, points, strict=True)
    ]
    counts: list[tuple[int, int]] = []
    for seed in range(MANY_SEEDS):
        if seed == SEEDS and np.mean(counts, axis=0)[0] >= FEW:
            break
        found = match_descriptors(*descriptors, matcher, ratio=chosen.ratio, seed=seed)
        matched = points[0][found.rows0], points[1][found.rows1]
        errors = transfer_errors(*matched, pair.homography)
        counts.append((int(np.count_nonzero(errors < CORRECT)), len(found)))
    correct, matches = np.rint(np.mean(counts, axis=0)).astype(int).tolist()
    return correct, matches
