"""Keypoints of all scales, best first."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ...features.keypoints import Keypoints
from ...features.scale_space import dominant_angles
from ...features.selection import (
    check_ignore,
    spread_by_distance,
    spread_over_grid,
    suppress_neighbors,
)
from .candidate_features import describe_candidates
from .hessian_scales import build_scale_space, check_memory, find_candidates
from .ranker import Ranker, load_ranker

Spread = Literal["none", "grid", "anms"]
SPREADS = ("none", "grid", "anms")

CANDIDATES_PER_KEYPOINT, MIN_CANDIDATES = 6, 8192
"""Of a limited number of keypoints that are not spread so many times as many candidates are ranked,
but at least so many: those with the strongest response."""

GRID_CELLS = 16
"""Of the spread "grid", along the longer side."""

DISTANCE_PX = 2.0
"""Least distance of two keypoints, also of different scales."""

DISTANCE_PER_SIGMA = 1.0
"""Least distance of two keypoints over the smaller one's sigma, so that one structure is not found
several times at neighbouring scales."""

SIZE_PER_SIGMA = 2.5
"""Diameter of a keypoint, as descriptors take it, over the sigma of its scale."""


def least_distances(sigma_px: np.ndarray) -> np.ndarray:
    """Return (N,) radii within which a keypoint drives out others of its size or larger."""
    radii: np.ndarray = np.maximum(DISTANCE_PX, DISTANCE_PER_SIGMA * sigma_px)
    return radii


def detect_points(
    gray: np.ndarray,
    max_keypoints: int | None = None,
    *,
    spread: Spread = "none",
    ignore: np.ndarray | None = None,
    ranker: Ranker | None = None,
) -> Keypoints:
    """Detect keypoints of all scales.

    Candidates are the maxima of |det Hessian| at seven scales; a small trained network ranks them
    by how surely they are found again in another photograph of the same place.

    Args:
        gray: (H, W) uint8.
        max_keypoints: at most this many; None: all.
        spread: "none": the best; "grid": in turn the best of each cell of a grid; "anms": the
            best, at least so far from each other that there are just enough (adaptive
            non-maximal suppression).
        ignore: (H, W) array, true where no keypoint is wanted.
        ranker: None: the trained one inside the package.

    Returns:
        Keypoints with sub-pixel positions (centre of the first pixel (0, 0)), sizes in pixels and
        angles in degrees, best first; their logits rank them, and so do their scores in (0, 1), of
        which no two are equal.

    Raises:
        OptionError: the mask does not fit, or the image is too large for the memory.

    Example:
        >>> gray = np.zeros((64, 64), np.uint8)
        >>> gray[20:40, 24:44] = 255
        >>> len(detect_points(gray, 4))
        4
    """
    check_memory(gray.shape)
    space = build_scale_space(gray)
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
    if max_keypoints is not None and spread == "none":
        most = max(CANDIDATES_PER_KEYPOINT * max_keypoints, MIN_CANDIDATES)
        rows = rows[np.argsort(-strength[rows], kind="stable")[:most]]
    logits = (ranker or load_ranker()).rank(describe_candidates(space, candidates, rows))
    candidates = candidates[rows]
    kept = suppress_neighbors(candidates.xy, logits, least_distances(candidates.sigma_px))
    kept = kept[_choose(candidates.xy[kept], logits[kept], size, max_keypoints, spread)]
    xy, sizes = candidates.xy[kept], SIZE_PER_SIGMA * candidates.sigma_px[kept]
    angles = dominant_angles(gray, xy, sizes)
    scores = ranking_scores(logits[kept])
    return Keypoints(xy, scores, size, logits=logits[kept], sizes=sizes, angles=angles)


def ranking_scores(logits: np.ndarray) -> np.ndarray:
    """Map logits that do not rise to scores in (0, 1) that fall.

    Args:
        logits: (N,) float32, the highest first.

    Returns:
        (N,) float32; where rounding makes two equal, the later one gets the next lower number.

    Example:
        >>> ranking_scores(np.array([1, 0, 0, -1], np.float32)).round(2).tolist()
        [0.75, 0.5, 0.5, 0.25]
    """
    tail = 0.5 / (1 + np.abs(logits))
    scores = np.where(logits < 0, tail, 1 - tail).astype(np.float32)
    # Of positive numbers the bits are in the same order.
    place = np.arange(len(scores), dtype=np.int32)
    return (np.minimum.accumulate(scores.view(np.int32) + place) - place).view(np.float32)


def _choose(
    xy: np.ndarray, logits: np.ndarray, size: tuple[int, int], count: int | None, spread: Spread
) -> np.ndarray:
    """Return rows of keypoints that are ordered from best to worst, in the same order."""
    if count is None or count >= len(xy):
        return np.arange(len(xy))
    if spread == "grid":
        return np.sort(spread_over_grid(xy, logits, size, count, GRID_CELLS))
    if spread == "anms":
        return np.sort(spread_by_distance(xy, logits, count))
    return np.arange(count)
