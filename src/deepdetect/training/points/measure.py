"""The validation metric: what a ranking is judged and chosen by, on images not trained on.

One-to-one repeatability at fixed budgets, and correct matches by upright descriptors, on a fixed,
seeded set of synthetic pairs, as many of each kind, by the functions of the benchmark. Points
outside the image are dropped before the best are taken, for every detector alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ...detector.points.detection import detect_points
from ...detector.points.ranker import Ranker
from ...evaluation.metrics.homography import Sizes
from ...evaluation.metrics.matching import match_accuracy
from ...evaluation.metrics.repeatability import repeated_fractions
from ...features.keypoints import Keypoints
from ...features.matchers import get_matcher, match_descriptors
from ...features.sift import root_sift_descriptors
from ...io.image import find_images, load_image, luma
from .views import KINDS, ViewPair, draw_pair

IMAGE_PIXELS = 800 * 640
"""Of the image that budgets are for; smaller views get as many keypoints per pixel."""

BUDGETS = (512, 2048, 8192)
RADII_PX = (1.0, 3.0)
MATCHING_BUDGET = 2048
DESCRIPTOR_SIZE_PX = 4.0
RATIO = 0.85
SIDE_PX = 256

Detect = Callable[[np.ndarray], Keypoints]
"""From a (H, W) uint8 image to keypoints."""


@dataclass(frozen=True)
class ValidationMetric:
    """Repeatability and matches by kind of pair.

    Attributes:
        repeatability: for each kind the means, (3, 2): budgets `BUDGETS` by radii `RADII_PX`.
        correct: for each kind the mean number of matches correct to 1 px at `MATCHING_BUDGET`, over
            that budget; upright RootSIFT of size 4, mutual, ratio .85.
    """

    repeatability: Mapping[str, np.ndarray]
    correct: Mapping[str, float]

    @property
    def mean(self) -> np.ndarray:
        """The mean repeatability over the kinds, (3, 2)."""
        return np.mean(list(self.repeatability.values()), axis=0)

    @property
    def mean_correct(self) -> float:
        """The mean of `correct` over the kinds."""
        return float(np.mean(list(self.correct.values())))

    @property
    def score(self) -> float:
        """One number to choose by: four parts repeatability, one part twice the correct matches.

        Upright descriptors find nothing in zoomed and turned pairs, so `correct` is half as large.
        """
        return float(0.8 * self.mean.mean() + 0.2 * 2 * self.mean_correct)


def validation_pairs(
    folder: Path, pairs_per_kind: int = 16, side: int = SIDE_PX, seed: int = 0
) -> list[ViewPair]:
    """Draw the fixed set of pairs, each of another image of the folder where they suffice.

    Raises:
        ImageError: the folder is missing or empty.
    """
    files = find_images(folder)
    order = np.random.default_rng([seed, 1]).permutation(len(files))
    pairs = []
    for number in range(pairs_per_kind * len(KINDS)):
        generator = np.random.default_rng([seed, 2, number])
        gray = luma(load_image(files[order[number % len(files)]]))
        pairs.append(draw_pair(gray, KINDS[number % len(KINDS)], side, generator))
    return pairs


def measure(detect: Detect, pairs: Sequence[ViewPair]) -> ValidationMetric:
    """Measure a detector."""
    found: dict[str, list[np.ndarray]] = {}
    correct: dict[str, list[float]] = {}
    for pair in pairs:
        points = [
            _valid(detect(image), valid)
            for image, valid in zip(pair.images, pair.valid, strict=True)
        ]
        height, width = pair.images[0].shape
        sizes = ((width, height), (width, height))
        rows = []
        for budget in BUDGETS:
            count = max(1, round(budget * width * height / IMAGE_PIXELS))
            best = [each.best(count) for each in points]
            first, second = (each.xy for each in best)
            rows.append(repeated_fractions(first, second, pair.homography, sizes, RADII_PX))
            if budget == MATCHING_BUDGET:
                correct.setdefault(pair.kind, []).append(_correct(pair, best, sizes) / count)
        found.setdefault(pair.kind, []).append(np.array(rows))
    return ValidationMetric(
        {kind: np.mean(values, axis=0) for kind, values in found.items()},
        {kind: float(np.mean(values)) for kind, values in correct.items()},
    )


def _correct(pair: ViewPair, points: Sequence[Keypoints], sizes: Sizes) -> int:
    """Return the number of matches correct to 1 px."""
    described = [
        root_sift_descriptors(image, each.xy, DESCRIPTOR_SIZE_PX)
        for image, each in zip(pair.images, points, strict=True)
    ]
    if min(len(each) for each in points) < 2:
        return 0
    matches = match_descriptors(
        described[0], described[1], get_matcher("exact"), ratio=RATIO, mutual=True
    )
    first, second = points[0].xy[matches.indices0], points[1].xy[matches.indices1]
    found = match_accuracy(first, second, points[0].xy, points[1].xy, pair.homography, sizes)
    return int(found.correct[0])


def _valid(points: Keypoints, valid: np.ndarray) -> Keypoints:
    points = points.distinct()
    column, row = np.rint(points.xy).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < valid.shape[1]) & (row < valid.shape[0])
    inside[inside] = valid[row[inside], column[inside]]
    return points[inside]


def points_detector(ranker: Ranker) -> Detect:
    """Return a detector that ranks by a ranker."""
    return partial(detect_points, ranker=ranker)
