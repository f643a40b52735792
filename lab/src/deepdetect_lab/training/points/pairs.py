"""Training pairs of the ranker: candidates of two views, their features and correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch.utils.data import Dataset

from deepdetect.detector.points.candidate_features import describe_candidates
from deepdetect.detector.points.hessian_scales import build_scale_space, find_candidates
from deepdetect.geometry.transforms import transform_points
from deepdetect.io.image import load_image, luma

from ..recipe import PointsTrainingOptions
from .views import KINDS, ViewPair, draw_pair

MAX_CANDIDATES = 2000
"""Number of candidates of a view that are kept, the strongest ones. Chosen by hand."""

REACH_PX = 3.0

MIN_OVERLAP = 0.04
"""Pairs whose views overlap by less than this fraction are drawn again, up to `ATTEMPTS` draws in
total. Chosen by hand."""

ATTEMPTS = 5


@dataclass(frozen=True, eq=False)
class ViewCandidates:
    """The candidates of one view, and their possible correspondences in the other view.

    A candidate of this view is mapped to the other view, and paired with each candidate of the
    other view that is closer than `REACH_PX`.

    Attributes:
        xy: (N, 2) float64 positions in pixels.
        sigma_px: (N,) float64 scales.
        features: (N, F) float32 inputs of the ranker.
        visible: (N,) bool, whether the other view shows the candidate's position.
        first: (P,) int64, for each pair the row of its candidate in this view.
        second: (P,) int64, for each pair the row of its candidate in the other view.
        distance_px: (P,) distances in the pairs, in pixels of the other view.
    """

    xy: np.ndarray
    sigma_px: np.ndarray
    features: np.ndarray
    visible: np.ndarray
    first: np.ndarray
    second: np.ndarray
    distance_px: np.ndarray


@dataclass(frozen=True, eq=False)
class CandidatePair:
    """Two views of one image, and the number of keypoints to keep in each of them."""

    views: tuple[ViewCandidates, ViewCandidates]
    budget: float


def candidate_pair(pair: ViewPair, density: float) -> CandidatePair:
    """Find the candidates of both views and their correspondences.

    The budget is `density`, in keypoints per pixel, times the number of pixels of a view.
    """
    sides = []
    for image, valid in zip(pair.images, pair.valid, strict=True):
        space = build_scale_space(image)
        candidates = find_candidates(space)
        features = describe_candidates(space, candidates)
        rows = np.flatnonzero(valid[candidates.pixels])
        strongest = np.argsort(-features[rows, 0], kind="stable")[:MAX_CANDIDATES]
        rows = rows[np.sort(strongest)]
        sides.append((candidates.xy[rows], candidates.sigma_px[rows], features[rows]))
    views = []
    for k, homography in enumerate((pair.homography, np.linalg.inv(pair.homography))):
        here, there = sides[k][0], sides[1 - k][0]
        close = _correspondences(here, there, homography, pair.valid[1 - k])
        views.append(ViewCandidates(*sides[k], *close))
    return CandidatePair((views[0], views[1]), density * pair.images[0].size)


def _correspondences(
    here: np.ndarray, there: np.ndarray, homography: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, ...]:
    mapped = np.column_stack([here, np.ones(len(here))]) @ (homography / homography[2, 2]).T
    depth = mapped[:, 2:]
    before = depth[:, 0] > 0  # all other positions lie behind the camera
    mapped = np.where(before[:, None], mapped[:, :2] / np.where(before[:, None], depth, 1), -1e6)
    height, width = valid.shape
    column, row = np.rint(np.clip(mapped, -1e6, 1e6)).astype(np.int64).T
    rows = np.flatnonzero((column >= 0) & (row >= 0) & (column < width) & (row < height))
    rows = rows[valid[row[rows], column[rows]]]
    visible = np.zeros(len(here), bool)
    visible[rows] = True
    # For a few thousand candidates, computing all distances is faster than searching a tree.
    squared = np.square(mapped[rows, :1] - there[:, 0]) + np.square(mapped[rows, 1:] - there[:, 1])
    near, second = np.nonzero(squared < REACH_PX**2)
    first, distance = rows[near], np.sqrt(squared[near, second])
    return visible, first, second, distance


class PairDataset(Dataset[CandidatePair]):
    """Random pairs of views, each determined by the seed, the step, and its number in the step."""

    def __init__(self, files: Sequence[Path], options: PointsTrainingOptions) -> None:
        self.files, self.options = list(files), options

    def __getitem__(self, index: tuple[int, int]) -> CandidatePair:
        options = self.options
        generator = np.random.default_rng([options.seed, 3, *index])
        kind = str(generator.choice(KINDS, p=np.full(len(KINDS), 1 / len(KINDS))))
        for _ in range(ATTEMPTS):
            file = self.files[int(generator.integers(len(self.files)))]
            gray = luma(load_image(file))
            pair = draw_pair(gray, kind, options.side, generator)
            if overlap(pair) > MIN_OVERLAP and np.ptp(pair.images[0]) > 20:
                break
        low, high = np.log([options.min_density, options.max_density])
        density = float(np.exp(generator.uniform(low, high)))
        return candidate_pair(pair, density)


def overlap(pair: ViewPair) -> float:
    """Return the overlap: the smaller of the fractions of each view that the other view shows."""
    side = pair.images[0].shape[0]
    ticks = np.linspace(0, side - 1, 24)
    grid = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    seen = [transform_points(grid, m) for m in (pair.homography, np.linalg.inv(pair.homography))]
    return min(float(((xy > 0) & (xy < side - 1)).all(1).mean()) for xy in seen)
