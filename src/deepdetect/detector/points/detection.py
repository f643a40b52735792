"""Detection of keypoints of all scales, best first."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..._shared.machine import require_memory
from ...features.keypoints import Keypoints
from ...features.scale_space import dominant_angles
from ...features.selection import (
    check_ignore,
    spread_by_distance,
    spread_over_grid,
    suppress_neighbors,
)
from .candidate_features import describe_candidates
from .hessian_scales import SIGMAS_PX, Candidates, build_scale_space, find_candidates
from .ranker import Ranker, load_ranker

Spread = Literal["none", "grid", "anms"]
SPREADS = ("none", "grid", "anms")

CANDIDATES_PER_KEYPOINT, MIN_CANDIDATES = 6, 8192
"""The ranker gets the candidates with the highest |det Hessian|: `CANDIDATES_PER_KEYPOINT` for each
wanted keypoint, but at least `MIN_CANDIDATES` in all. The ranker gets every candidate if all
keypoints are wanted, or if keypoints are spread. With three candidates per keypoint, 640x480 pixels
took 49 instead of 56 ms, but repeatability within 3 px fell by 0.01 (images not recorded)."""

TILE_PX = 32
"""Side of the square tiles by which candidates are sorted for cache locality. Chosen by hand."""

GRID_CELLS = 16
"""Number of grid cells along the longer side of the image if `spread` is "grid". Chosen by hand."""

DISTANCE_PX, DISTANCE_PER_SIGMA = 2.0, 1.0
"""Keypoints are at least DISTANCE_PX and DISTANCE_PER_SIGMA sigmas of the smaller one apart, so no
structure is found at several scales. On pairs made of photos/val, the sigmas raised the ranker's
score (mostly repeatability) from 0.539 to 0.543; 1.5 or 2.3 for 2 px changed it by under 0.003."""

SIZE_PER_SIGMA = 2.5
"""Diameter at which a keypoint is described, divided by the sigma of its scale. Chosen by hand."""


def least_distances(sigma_px: np.ndarray) -> np.ndarray:
    """Return, for (N,) sigmas, the minimum distances to keypoints of the same or a larger sigma."""
    return np.asarray(np.maximum(DISTANCE_PX, DISTANCE_PER_SIGMA * sigma_px))


def detect_points(
    gray: np.ndarray,
    max_keypoints: int | None = None,
    *,
    spread: Spread = "none",
    ignore: np.ndarray | None = None,
    ranker: Ranker | None = None,
) -> Keypoints:
    """Detect keypoints of all scales in a (H, W) uint8 image, best first, as `PointDetector` does.

    The logits come from the ranker. `ranking_scores` turns the logits into scores.
    """
    # Spreading needs all candidates: in regions of low contrast, none are among the strongest.
    limit = max_keypoints if spread == "none" else None
    strongest = None if limit is None else max(CANDIDATES_PER_KEYPOINT * limit, MIN_CANDIDATES)
    candidates, logits = rank_candidates(gray, strongest, ignore=ignore, ranker=ranker)
    size = gray.shape[1], gray.shape[0]
    if not len(candidates):
        none = np.empty(0, np.float32)
        return Keypoints(np.empty((0, 2)), none, size, logits=none, sizes=none, angles=none)
    radii = least_distances(candidates.sigma_px)
    kept = suppress_neighbors(candidates.xy, logits, radii, limit)
    if max_keypoints is not None and len(kept) > max_keypoints:  # keypoints are to be spread
        found = candidates.xy[kept], logits[kept]
        if spread == "grid":
            chosen = spread_over_grid(*found, size, max_keypoints, GRID_CELLS)
        else:
            chosen = spread_by_distance(*found, max_keypoints)
        kept = kept[np.sort(chosen)]  # best first, as before
    xy, sizes = candidates.xy[kept], SIZE_PER_SIGMA * candidates.sigma_px[kept]
    angles = dominant_angles(gray, xy, sizes)
    scores = ranking_scores(logits[kept])
    return Keypoints(xy, scores, size, logits=logits[kept], sizes=sizes, angles=angles)


def rank_candidates(
    gray: np.ndarray,
    strongest: int | None = None,
    *,
    ignore: np.ndarray | None = None,
    ranker: Ranker | None = None,
) -> tuple[Candidates, np.ndarray]:
    """Return the `strongest` candidates (None: all) of a (H, W) uint8 image, and their logits."""
    height, width = gray.shape
    require_memory(
        f"points of an image of {width}x{height} pixels",
        "use `resolution='auto'`, or a smaller image",
        pixel_of_level=gray.size * len(SIGMAS_PX),
    )
    space = build_scale_space(gray)
    candidates = find_candidates(space)
    rows = np.argsort(candidates.rank)
    if ignore is not None:
        wanted = ~check_ignore(ignore, gray.shape)[candidates.row, candidates.column]
        rows = rows[wanted[rows]]
    rows = rows[:strongest]
    # In the order of tiles, successive candidates of all scales use the same cached pixels.
    tiles = (candidates.row // TILE_PX << 8) + candidates.column // TILE_PX
    candidates = candidates[rows[np.argsort(tiles[rows].astype(np.uint16), kind="stable")]]
    return candidates, (ranker or load_ranker()).rank(describe_candidates(space, candidates))


def ranking_scores(logits: np.ndarray) -> np.ndarray:
    """Map (N,) float32 logits in descending order to strictly descending scores in (0, 1).

    If rounding makes two scores equal, the later one gets the next lower float32 number.
    """
    tail = 0.5 / (1 + np.abs(logits))
    scores = np.where(logits < 0, tail, 1 - tail).astype(np.float32)
    # The bits of positive floats have the same order as the numbers.
    place = np.arange(len(scores), dtype=np.int32)
    return (np.minimum.accumulate(scores.view(np.int32) + place) - place).view(np.float32)
