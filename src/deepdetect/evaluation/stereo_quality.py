"""True matches on rectified stereo pairs: of weights, of label settings, and of controls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..datasets.types import StereoPair
from ..detector.detector import HeatmapDetector
from ..features.matches import Matches
from ..io.image import load_image, luma
from ..labels import LabelOptions, fuse
from ..matching.pipeline import match_images
from .controls import EveryPixel, RandomPoints
from .metrics.stereo_matches import StereoScore, stereo_score


@dataclass(frozen=True)
class StereoQuality:
    """What one source of keypoints gives on one pair.

    Attributes:
        source: its name.
        pair: the pair's name.
        density: keypoints a pixel, mean of both views.
        score: its matches, and how many of them are right.
    """

    source: str
    pair: str
    density: float
    score: StereoScore


class LabelKeypoints:
    """A detector whose keypoints are the fusion label itself, without a network.

    Args:
        options: how labels are made.

    Example:
        >>> image = np.zeros((32, 32), np.uint8)
        >>> image[8:24, 8:24] = 255
        >>> float(LabelKeypoints().heatmap(image)[8, 8])
        1.0
    """

    def __init__(self, options: LabelOptions = LabelOptions()) -> None:
        self.options = options

    def heatmap(self, image: Any) -> np.ndarray:
        """Return the label as (H, W) float32, 0 or 1."""
        return fuse(luma(load_image(image)), self.options).mask.astype(np.float32)


def stereo_quality(
    sources: Mapping[str, HeatmapDetector],
    pairs: Sequence[StereoPair],
    done: Callable[[int], object] = lambda _: None,
) -> list[StereoQuality]:
    """Match rectified pairs with several sources of keypoints, and judge the matches.

    Matching is unguided (SIFT descriptors, FLANN, ratio 0.99) over the whole image: neither the
    rows nor the true disparity are used. Beside each source stand random points at its density,
    since more keypoints always find more; every pixel is the last row.

    Args:
        sources: detectors by name.
        pairs: with their true disparity, for judging only.
        done: called with 1 after each of (2 sources + 1) x pairs matchings.

    Returns:
        For each source its rows and then the control's, pair by pair.
    """

    def judged(source: str, pair: StereoPair, found: Matches) -> StereoQuality:
        done(1)
        density = (found.keypoints0.density + found.keypoints1.density) / 2
        score = stereo_score(found.points0, found.points1, pair.disparity)
        return StereoQuality(source, pair.name, density, score)

    rows: list[StereoQuality] = []
    for name, detector in sources.items():
        own = [judged(name, pair, match_stereo(pair, detector)) for pair in pairs]
        control = f"random, as {name}"
        rows += own
        rows += [
            judged(control, pair, match_random_points(pair, row.density))
            for pair, row in zip(pairs, own, strict=True)
        ]
    every = EveryPixel()
    return rows + [judged("every pixel", pair, match_stereo(pair, every)) for pair in pairs]


def match_stereo(pair: StereoPair, detector: HeatmapDetector, **changes: Any) -> Matches:
    """Match both views, unguided and without looking for their geometry."""
    return match_images(pair.left, pair.right, detector, guided=False, model="none", **changes)


def match_random_points(pair: StereoPair, density: float) -> Matches:
    """Match random points of a density, in keypoints a pixel: the control."""
    return match_stereo(pair, RandomPoints(), density=max(density, 1e-6))
