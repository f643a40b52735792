"""Keypoints of all scales, best first."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ..._shared.errors import OptionError, unknown_name
from ..._shared.options import check_ranges, suggest_keywords
from ...features.keypoints import Keypoints
from ...features.orientation import dominant_angles
from ...features.selection import SPREADS, check_ignore, check_max_keypoints
from ...features.sift_detector import spread_over_grid
from ...features.suppression import spread_by_distance, suppress_neighbors
from .candidate_features import describe_candidates
from .hessian_scales import (
    ScaleSpaceOptions,
    build_scale_space,
    check_memory,
    find_candidates,
)
from .ranker import Ranker, load_ranker


@suggest_keywords
@dataclass(frozen=True)
class PointOptions:
    """Which candidates become keypoints.

    Attributes:
        max_keypoints: at most this many; None: all.
        candidates_per_keypoint, min_candidates: with `max_keypoints` and without `spread`, so
            many times as many candidates are ranked, but at least so many: those with the
            strongest response.
        spread: "none": the best; "grid": in turn the best of each cell of a grid; "anms": the
            best, at least so far from each other that there are just enough (adaptive
            non-maximal suppression).
        grid_cells: of "grid", along the longer side.
        distance_px: least distance of two keypoints, also of different scales.
        distance_per_sigma: least distance of two keypoints over the smaller one's sigma, so that
            one structure is not found several times at neighbouring scales.
        size_per_sigma: diameter of a keypoint, as descriptors take it, over the sigma of its
            scale.
        scales: of the scale space.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    max_keypoints: int | None = None
    candidates_per_keypoint: int = 6
    min_candidates: int = 8192
    spread: str = "none"
    grid_cells: int = 16
    distance_px: float = 2.0
    distance_per_sigma: float = 1.0
    size_per_sigma: float = 2.5
    scales: ScaleSpaceOptions = field(default_factory=ScaleSpaceOptions)

    def __post_init__(self) -> None:
        check_max_keypoints(self.max_keypoints)
        if self.spread not in SPREADS:
            raise unknown_name("spread", self.spread, SPREADS)
        if self.spread != "none" and self.max_keypoints is None:
            raise OptionError(f"`spread={self.spread!r}` needs `max_keypoints`: how many to spread")
        check_ranges(
            self,
            positive=("distance_px", "size_per_sigma"),
            not_negative=("distance_per_sigma",),
            between={
                "candidates_per_keypoint": (1, math.inf),
                "min_candidates": (1, math.inf),
                "grid_cells": (1, math.inf),
            },
        )

    def least_distances(self, sigma_px: np.ndarray) -> np.ndarray:
        """Return (N,) radii within which a keypoint drives out others of its size or larger."""
        radii: np.ndarray = np.maximum(self.distance_px, self.distance_per_sigma * sigma_px)
        return radii


def detect_points(
    gray: np.ndarray,
    options: PointOptions = PointOptions(),
    *,
    ignore: np.ndarray | None = None,
    ranker: Ranker | None = None,
) -> Keypoints:
    """Detect keypoints of all scales.

    Candidates are the maxima of |det Hessian| at seven scales; a small trained network ranks them
    by how surely they are found again in another photograph of the same place.

    Args:
        gray: (H, W) uint8.
        options: how many, and how they are spread.
        ignore: (H, W) array, true where no keypoint is wanted.
        ranker: None: the trained one inside the package.

    Returns:
        Keypoints with sub-pixel positions (centre of the first pixel (0, 0)), sizes in pixels and
        angles in degrees, best first; their logits rank them, and their scores are the logits'
        sigmoid.

    Raises:
        OptionError: the mask does not fit, or the image is too large for the memory.

    Example:
        >>> gray = np.zeros((64, 64), np.uint8)
        >>> gray[20:40, 24:44] = 255
        >>> len(detect_points(gray, PointOptions(max_keypoints=4)))
        4
    """
    check_memory(gray.shape, options.scales)
    space = build_scale_space(gray, options.scales)
    candidates = find_candidates(space)
    size = (gray.shape[1], gray.shape[0])
    if not len(candidates):
        none = np.empty(0, np.float32)
        return Keypoints(np.empty((0, 2)), none, size, logits=none, sizes=none, angles=none)
    strength = candidates.strength(space)
    rows = np.arange(len(candidates))
    if ignore is not None:
        wanted = ~check_ignore(ignore, gray.shape)[candidates.row, candidates.column]
        rows = rows[wanted]
    # The strongest alone would leave nothing to spread over dim regions.
    if options.max_keypoints is not None and options.spread == "none":
        most = max(options.candidates_per_keypoint * options.max_keypoints, options.min_candidates)
        rows = rows[np.argsort(-strength[rows], kind="stable")[:most]]
    logits = (ranker or load_ranker()).rank(describe_candidates(space, candidates, rows))
    candidates = candidates[rows]
    kept = suppress_neighbors(candidates.xy, logits, options.least_distances(candidates.sigma_px))
    kept = kept[_choose(candidates.xy[kept], logits[kept], size, options)]
    decay = np.exp(-np.abs(logits[kept]))
    scores = np.where(logits[kept] >= 0, 1, decay) / (1 + decay)
    xy, sizes = candidates.xy[kept], options.size_per_sigma * candidates.sigma_px[kept]
    angles = dominant_angles(gray, xy, sizes)
    return Keypoints(xy, scores, size, logits=logits[kept], sizes=sizes, angles=angles)


def _choose(
    xy: np.ndarray, logits: np.ndarray, size: tuple[int, int], options: PointOptions
) -> np.ndarray:
    """Return rows of keypoints that are ordered from best to worst, in the same order."""
    count = options.max_keypoints
    if count is None or count >= len(xy):
        return np.arange(len(xy))
    if options.spread == "grid":
        return np.sort(spread_over_grid(xy, logits, size, count, options.grid_cells))
    if options.spread == "anms":
        return np.sort(spread_by_distance(xy, logits, count))
    return np.arange(count)
