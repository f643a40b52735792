"""Pairs of views as the ranker sees them: candidates, features, and which see the same place.

`PairDataset` draws them from images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch.utils.data import Dataset

from ...detector.points.candidate_features import describe_candidates
from ...detector.points.hessian_scales import build_scale_space, find_candidates
from ...features.sift import root_sift_descriptors
from ...io.image import load_image, luma
from ..recipe import PointsTrainingOptions
from .views import KINDS, ViewPair, draw_pair

MAX_CANDIDATES = 2000
"""Of each view; the strongest are ranked."""

REACH_PX = 3.0
DESCRIPTOR_SIZE_PX = 4.0
RATIO = 0.85


@dataclass(frozen=True, eq=False)
class Side:
    """The candidates of one view.

    Attributes:
        xy: (N, 2) float64 positions.
        sigma_px: (N,) float64 of their scales.
        features: (N, F) float32.
    """

    xy: np.ndarray
    sigma_px: np.ndarray
    features: np.ndarray


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Candidates of one view that see one of the other, by distance in the other.

    Attributes:
        first, second: (P,) int64 rows of both views.
        distance_px: (P,) in pixels of the view that the first one is projected into.
        visible: (N,) bool: whether the other view shows a candidate of the first.
        matchable: (P,) bool: whether the upright descriptors pass the ratio test against all
            other candidates of the second view.
    """

    first: np.ndarray
    second: np.ndarray
    distance_px: np.ndarray
    visible: np.ndarray
    matchable: np.ndarray


@dataclass(frozen=True, eq=False)
class CandidatePair:
    """Two views of one image.

    Attributes:
        sides: candidates of the first and the second view.
        ways: from the first view to the second, and back.
        area: of a view in pixels.
    """

    sides: tuple[Side, Side]
    ways: tuple[Correspondences, Correspondences]
    area: int


def candidate_pair(pair: ViewPair, with_descriptors: bool) -> CandidatePair:
    """Find the candidates of both views, and which see the same place.

    Args:
        pair: the views.
        with_descriptors: find out which are matchable; else all are said to be.
    """
    sides, described = [], []
    for image, valid in zip(pair.images, pair.valid, strict=True):
        space = build_scale_space(image)
        candidates = find_candidates(space)
        features = describe_candidates(space, candidates)
        rows = np.flatnonzero(valid[candidates.row, candidates.column])
        strongest = np.argsort(-features[rows, 0], kind="stable")[:MAX_CANDIDATES]
        rows = rows[np.sort(strongest)]
        sides.append(Side(candidates.xy[rows], candidates.sigma_px[rows], features[rows]))
        if with_descriptors:
            xy = sides[-1].xy.astype(np.float32)
            found = root_sift_descriptors(image, xy, DESCRIPTOR_SIZE_PX).astype(np.float32)
            length = np.linalg.norm(found, axis=1, keepdims=True)
            described.append(found / np.maximum(length, 1e-6))
    back = np.linalg.inv(pair.homography)
    ways = []
    for k, homography in enumerate((pair.homography, back)):
        here, there = sides[k], sides[1 - k]
        similarity = described[k] @ described[1 - k].T if with_descriptors else None
        ways.append(_correspondences(here.xy, there.xy, homography, pair.valid[1 - k], similarity))
    return CandidatePair((sides[0], sides[1]), (ways[0], ways[1]), pair.images[0].size)


def _correspondences(
    here: np.ndarray,
    there: np.ndarray,
    homography: np.ndarray,
    valid: np.ndarray,
    similarity: np.ndarray | None,
) -> Correspondences:
    visible = np.zeros(len(here), bool)
    none = np.zeros(0, np.int64)
    if not len(here) or not len(there):
        return Correspondences(none, none, np.zeros(0), visible, np.zeros(0, bool))
    mapped = np.column_stack([here, np.ones(len(here))]) @ (homography / homography[2, 2]).T
    depth = mapped[:, 2:]
    before = depth[:, 0] > 0  # others lie behind the camera of the tilted view
    mapped = np.where(before[:, None], mapped[:, :2] / np.where(before[:, None], depth, 1), -1e6)
    height, width = valid.shape
    column, row = np.rint(np.clip(mapped, -1e6, 1e6)).astype(np.int64).T
    rows = np.flatnonzero((column >= 0) & (row >= 0) & (column < width) & (row < height))
    rows = rows[valid[row[rows], column[rows]]]
    visible[rows] = True
    if not len(rows):
        return Correspondences(none, none, np.zeros(0), visible, np.zeros(0, bool))
    # A few thousand candidates: all distances are quicker than a tree, and need no package.
    squared = np.square(mapped[rows, :1] - there[:, 0]) + np.square(mapped[rows, 1:] - there[:, 1])
    near, second = np.nonzero(squared < REACH_PX**2)
    first, distance = rows[near], np.sqrt(squared[near, second])
    matchable = np.ones(len(first), bool)
    if similarity is not None:
        others = similarity.copy()
        others[first, second] = -1  # several candidates near the place may match as well
        unlike = np.sqrt(np.maximum(0, 2 - 2 * similarity[first, second]))
        matchable = unlike < RATIO * np.sqrt(np.maximum(0, 2 - 2 * others.max(1)))[first]
    return Correspondences(first, second, distance, visible, matchable)


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
    """Pairs of views of images; each a pure function of its index and the seed."""

    def __init__(self, files: Sequence[Path], options: PointsTrainingOptions) -> None:
        self.files, self.options = list(files), options

    def __len__(self) -> int:
        return self.options.steps * self.options.pairs

    def __getitem__(self, index: PairIndex) -> PairSample:
        options = self.options
        generator = np.random.default_rng([options.seed, 3, index.step, index.position])
        kind = KINDS[int(generator.choice(len(KINDS), p=np.full(len(KINDS), 1 / len(KINDS))))]
        for _ in range(ATTEMPTS):
            file = self.files[int(generator.integers(len(self.files)))]
            gray = luma(load_image(file))
            pair = draw_pair(gray, kind, options.side, generator)
            if min(overlaps(pair)) > MIN_OVERLAP and np.ptp(pair.images[0]) > 20:
                break
        # Upright descriptors cannot match turned and zoomed views: there all count as matchable.
        described = options.match_weight > 0 and kind != "zoom"
        candidates = candidate_pair(pair, described)
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
