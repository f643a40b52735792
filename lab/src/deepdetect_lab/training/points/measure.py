"""The validation metric of the ranker, on a fixed set of synthetic pairs.

It combines the one-to-one repeatability for fixed numbers of keypoints (budgets) and the correct
matches of upright descriptors. Keypoints where a view does not show the photograph are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from deepdetect.features.keypoints import Keypoints
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.features.sift import root_sift_descriptors
from deepdetect.io.image import load_image, luma

from ...evaluation.metrics.homography import Sizes, match_accuracy
from ...evaluation.metrics.repeatability import mutual_nn_repeatability
from .views import KINDS, ViewPair, draw_pair

IMAGE_PIXELS = 800 * 640
"""The numbers of keypoints in `BUDGETS` are for an image with this number of pixels. Views with
fewer pixels get proportionally fewer keypoints."""

BUDGETS = (512, 2048, 8192)
RADII_PX = (1.0, 3.0)
MATCHING_BUDGET = 2048
DESCRIPTOR_SIZE_PX = 4.0
RATIO = 0.85
SIDE_PX = 256
"""Views have `SIDE_PX` pixels a side. RootSIFT describes keypoints with the diameter
`DESCRIPTOR_SIZE_PX`, and matches pass the ratio test with `RATIO`. All are chosen by hand."""

Detect = Callable[[np.ndarray], Keypoints]
"""A function from an (H, W) uint8 image to keypoints."""


MEASURES = [f"@{radius:g} px {budget}" for budget in BUDGETS for radius in RADII_PX] + ["correct"]
"""Names of the measures of each kind of pair. "@1 px 512" is the mean repeatability within 1 px at
a budget of 512 keypoints. "correct" is the mean number of upright RootSIFT matches that are correct
within 1 px, divided by the number of keypoints at `MATCHING_BUDGET`."""


def validation_pairs(files: Sequence[Path], pairs_per_kind: int) -> list[ViewPair]:
    """Draw the fixed set of pairs, each from a different image if there are enough images."""
    order = np.random.default_rng([0, 1]).permutation(len(files))
    pairs = []
    for number in range(pairs_per_kind * len(KINDS)):
        generator = np.random.default_rng([0, 2, number])
        gray = luma(load_image(files[order[number % len(files)]]))
        pairs.append(draw_pair(gray, KINDS[number % len(KINDS)], SIDE_PX, generator))
    return pairs


def measure(detect: Detect, pairs: Sequence[ViewPair]) -> dict[str, float]:
    """Return the "score" of a detector, and its measures by kind of pair as "KIND MEASURE"."""
    repeated: dict[str, list[list[list[float]]]] = {kind: [] for kind in KINDS}
    correct: dict[str, list[float]] = {kind: [] for kind in KINDS}
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
            by_radius = mutual_nn_repeatability(
                first, second, pair.homography, sizes, RADII_PX, with_chance=False
            )
            rows.append([fraction for fraction, _, _ in by_radius])
            if budget == MATCHING_BUDGET:
                correct[pair.kind].append(_correct(pair, best, sizes) / count)
        repeated[pair.kind].append(rows)
    means = np.array([np.mean(repeated[kind], axis=0) for kind in KINDS])
    matched = [float(np.mean(correct[kind])) for kind in KINDS]
    # The mean of `matched` counts double, because it includes pairs with zoom and rotation, in
    # which upright descriptors find no matches. The weights are chosen by hand.
    score = 0.8 * means.mean(0).mean() + 0.2 * 2 * float(np.mean(matched))
    found = {"score": float(score)}
    for kind, fractions, share in zip(KINDS, means, matched, strict=True):
        names = [f"{kind} {name}" for name in MEASURES]
        found |= zip(names, [*fractions.ravel().tolist(), share], strict=True)
    return found


def _correct(pair: ViewPair, points: Sequence[Keypoints], sizes: Sizes) -> int:
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
    correct: int = found["correct", 1]
    return correct


def _valid(points: Keypoints, valid: np.ndarray) -> Keypoints:
    points = points.distinct()
    column, row = np.rint(points.xy).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < valid.shape[1]) & (row < valid.shape[0])
    inside[inside] = valid[row[inside], column[inside]]
    return points[inside]
