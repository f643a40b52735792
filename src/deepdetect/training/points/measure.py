"""The hard measure: what a ranking is judged and chosen by, on photographs not trained on.

One-to-one repeatability at fixed budgets on a fixed, seeded set of synthetic pairs, as many of each
kind, by the functions of the benchmark. Points outside the photograph are dropped before the best
are taken, for every detector alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import nn

from ..._shared.errors import OptionError
from ...detector.detector import DeepDetect
from ...detector.points import LogitsOf, PyramidOptions, detect_points
from ...evaluation.baselines.hessian import detect_hessian, detect_hessian_scales
from ...evaluation.baselines.opencv import STANDARD
from ...evaluation.metrics.repeatability import repeated_fractions
from ...features.keypoints import Keypoints
from ...io.image import find_images, load_image, luma
from .views import KINDS, ViewPair, draw_pair

IMAGE_PIXELS = 800 * 640
"""Of the image that budgets are for; smaller views get as many keypoints per pixel."""

BUDGETS = (512, 2048)
RADII_PX = (1.0, 3.0)
SIDE_PX = 256

Detect = Callable[[np.ndarray], Keypoints]
"""From a (H, W) uint8 image to keypoints."""


@dataclass(frozen=True)
class HardMeasure:
    """Repeatability by kind of pair.

    Attributes:
        values: for each kind the (budget, radius) means, an array of (2, 2).
    """

    values: Mapping[str, np.ndarray]

    @property
    def mean(self) -> np.ndarray:
        """The mean over the kinds, (2, 2): budgets `BUDGETS` by radii `RADII_PX`."""
        return np.mean(list(self.values.values()), axis=0)

    @property
    def score(self) -> float:
        """One number to choose by: the mean over kinds, budgets and radii."""
        return float(self.mean.mean())

    def row(self) -> str:
        """Return the numbers in one line: of the mean, then of each kind."""
        cells = [("mean", self.mean), *self.values.items()]
        words = [f"{name} " + " ".join(f"{v:.3f}" for v in value.ravel()) for name, value in cells]
        return f"{self.score:.4f} | " + " | ".join(words)


def validation_pairs(
    folder: Path, pairs_per_kind: int = 16, side: int = SIDE_PX, seed: int = 0
) -> list[ViewPair]:
    """Draw the fixed set of pairs, each of another photograph of the folder where they suffice.

    Raises:
        ImageError: the folder is missing or empty.
    """
    files = find_images(folder)
    order = np.random.default_rng([seed, 1]).permutation(len(files))
    pairs = []
    for number in range(pairs_per_kind * len(KINDS)):
        generator = np.random.default_rng([seed, 2, number])
        photo = luma(load_image(files[order[number % len(files)]]))
        pairs.append(draw_pair(photo, KINDS[number % len(KINDS)], side, generator))
    return pairs


def measure(detect: Detect, pairs: Sequence[ViewPair]) -> HardMeasure:
    """Measure a detector."""
    found: dict[str, list[np.ndarray]] = {}
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
            first, second = (each.best(count).xy for each in points)
            rows.append(repeated_fractions(first, second, pair.homography, sizes, RADII_PX))
        found.setdefault(pair.kind, []).append(np.array(rows))
    return HardMeasure({kind: np.mean(values, axis=0) for kind, values in found.items()})


def _valid(points: Keypoints, valid: np.ndarray) -> Keypoints:
    points = points.distinct()
    column, row = np.rint(points.xy).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < valid.shape[1]) & (row < valid.shape[0])
    inside[inside] = valid[row[inside], column[inside]]
    return points[inside]


def head_logits(head: nn.Module) -> LogitsOf:
    """Return a function that runs a head on an image."""

    def run(gray: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            found: np.ndarray = head(torch.from_numpy(gray)[None, None])[0, 0].numpy()
        return found

    return run


def head_detector(head: nn.Module, options: PyramidOptions = PyramidOptions()) -> Detect:
    """Return a detector that runs a head on a pyramid."""
    return partial(detect_points, logits_of=head_logits(head), options=options)


def rivals() -> dict[str, Detect]:
    """Return the detectors to beat."""
    network = DeepDetect()

    def color(gray: np.ndarray) -> np.ndarray:
        return np.repeat(gray[:, :, None], 3, axis=2)

    def ours(gray: np.ndarray) -> Keypoints:
        return network.detect(color(gray), threshold=0, nms_radius=1, subpixel=True)

    return {
        "|det H| 3": detect_hessian,
        "scale space": detect_hessian_scales,
        "SIFT": lambda gray: STANDARD["sift"].detect(color(gray)),
        "Harris": lambda gray: STANDARD["harris"].detect(color(gray)),
        "DeepDetect": ours,
    }


def check_pairs(pairs: Sequence[ViewPair]) -> None:
    """Raise an OptionError where a kind is missing."""
    missing = set(KINDS) - {pair.kind for pair in pairs}
    if missing:
        raise OptionError(f"there are no pairs of the kinds {', '.join(sorted(missing))}")
