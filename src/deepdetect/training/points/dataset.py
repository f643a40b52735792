"""Pairs of views as a torch dataset, and their seeded sampler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch.utils.data import Dataset, Sampler

from ...io.image import load_image, luma
from .pairs import CandidatePair, candidate_pair
from .recipe import PointsTrainingOptions
from .views import KINDS, ViewPair, draw_pair

MIN_OVERLAP = 0.04
"""Of the second view: pairs that share less are drawn again."""

ATTEMPTS = 5


class PairIndex(NamedTuple):
    """What a pair depends on besides the seed: the step, and its place in the step."""

    step: int
    position: int


class PairSample(NamedTuple):
    """A pair of views, and the budget that it is trained for.

    Attributes:
        pair: candidates of both views.
        density: keypoints per pixel.
    """

    pair: CandidatePair
    density: float


class PairDataset(Dataset[PairSample]):
    """Pairs of views of photographs; each a pure function of its index and the seed."""

    def __init__(self, files: Sequence[Path], options: PointsTrainingOptions) -> None:
        self.files, self.options = list(files), options

    def __len__(self) -> int:
        return self.options.steps * self.options.pairs

    def __getitem__(self, index: PairIndex) -> PairSample:
        options = self.options
        generator = np.random.default_rng([options.seed, 3, index.step, index.position])
        weights = np.array(options.kind_weights)
        kind = KINDS[int(generator.choice(len(KINDS), p=weights / weights.sum()))]
        for _ in range(ATTEMPTS):
            file = self.files[int(generator.integers(len(self.files)))]
            photo = luma(load_image(file))
            pair = draw_pair(photo, kind, options.side, generator)
            if min(overlaps(pair)) > MIN_OVERLAP and np.ptp(pair.images[0]) > 20:
                break
        # Upright descriptors cannot match turned and zoomed views: there all count as matchable.
        described = options.match_weight > 0 and kind != "zoom"
        candidates = candidate_pair(pair, options.max_candidates, described)
        low, high = np.log([options.min_density, options.max_density])
        return PairSample(candidates, float(np.exp(generator.uniform(low, high))))


def overlaps(pair: ViewPair) -> tuple[float, float]:
    """Return which fraction of each view shows what the other one shows, on a coarse grid."""
    side = pair.images[0].shape[0]
    ticks = np.linspace(0, side - 1, 24)
    grid = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    found = []
    for matrix in (pair.homography, np.linalg.inv(pair.homography)):
        mapped = np.column_stack([grid, np.ones(len(grid))]) @ matrix.T
        xy = mapped[:, :2] / mapped[:, 2:]
        found.append(float(((xy > 0) & (xy < side - 1)).all(1).mean()))
    return found[0], found[1]


class PairSampler(Sampler[list[PairIndex]]):
    """The batches of consecutive steps, from the one on that a run resumes at."""

    def __init__(self, options: PointsTrainingOptions, first_step: int = 0) -> None:
        self.options, self.first_step = options, first_step

    def __len__(self) -> int:
        return self.options.steps - self.first_step

    def __iter__(self) -> Iterator[list[PairIndex]]:
        for step in range(self.first_step, self.options.steps):
            yield [PairIndex(step, position) for position in range(self.options.pairs)]
