"""Detection of keypoints of all scales, best first."""

from __future__ import annotations

from typing import Literal

import numpy as np

from ..._shared.machine import require_memory
from ...features.keypoints import Keypoints
from ...features.scale_space import SIZE_PER_SIGMA as SIFT_SIZE_PER_SIGMA
from ...features.scale_space import WINDOW_PER_SIGMA
from ...features.selection import (
    check_ignore,
    spread_by_distance,
    spread_over_grid,
    suppress_neighbors,
)
from .candidate_features import describe_candidates
from .hessian_scales import (
    ANGLE_OCTAVES,
    OCTAVES,
    SIGMAS_PX,
    Candidates,
    ScaleSpace,
    build_scale_space,
    find_candidates,
)
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

WINDOW_PER_LEVEL = WINDOW_PER_SIGMA * SIZE_PER_SIGMA / SIFT_SIZE_PER_SIGMA
"""Sigma of the window for an orientation, as in SIFT, divided by the sigma of the point's level."""


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
    min_logit: float | None = None,
) -> Keypoints:
    """Detect keypoints of all scales in a (H, W) uint8 image, best first, as `PointDetector` does.

    The logits come from the ranker. `ranking_scores` turns the logits into scores.
    """
    height, width = gray.shape
    require_memory(
        f"points of an image of {width}x{height} pixels",
        "use `resolution='auto'`, or a smaller image",
        pixel_of_level=gray.size * np.sum(0.25**OCTAVES),
    )
    if ignore is not None:
        ignore = check_ignore(ignore, gray.shape)
    # Spreading needs all candidates: in regions of low contrast, none are among the strongest.
    limit = max_keypoints if spread == "none" else None
    strongest = None if limit is None else max(CANDIDATES_PER_KEYPOINT * limit, MIN_CANDIDATES)
    space = build_scale_space(gray)
    candidates, logits = rank_candidates(space, strongest, ignore=ignore, ranker=ranker)
    if min_logit is not None:
        some = logits >= min_logit
        candidates, logits = candidates[some], logits[some]
    size = width, height
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
    candidates, logits = candidates[kept], logits[kept]
    sizes, angles = SIZE_PER_SIGMA * candidates.sigma_px, candidate_angles(space, candidates)
    scores = ranking_scores(logits)
    return Keypoints(candidates.xy, scores, size, logits=logits, sizes=sizes, angles=angles)


def rank_candidates(
    space: ScaleSpace,
    strongest: int | None = None,
    *,
    ignore: np.ndarray | None = None,
    ranker: Ranker | None = None,
) -> tuple[Candidates, np.ndarray]:
    """Return the `strongest` candidates (None: all) outside `ignore`, and their logits."""
    candidates = find_candidates(space, strongest, ignore)
    # In the order of tiles, successive candidates of all scales use the same cached pixels.
    row, column = (pixels // TILE_PX for pixels in candidates.pixels)
    candidates = candidates[np.argsort(((row << 8) + column).astype(np.uint16), kind="stable")]
    return candidates, (ranker or load_ranker()).rank(describe_candidates(space, candidates))


def candidate_angles(space: ScaleSpace, candidates: Candidates) -> np.ndarray:
    """Return the dominant orientation of each candidate, computed as in SIFT: (N,) float32 degrees.

    The gradients are those of the level that is one step coarser than the candidate's.
    """
    from ...features.kernels import strongest_directions

    angles = np.empty(len(candidates), np.float32)
    for level in np.unique(candidates.level):
        own, coarser = candidates.level == level, level + 1
        step, pixel = 2 ** (ANGLE_OCTAVES - OCTAVES)[coarser], 2.0 ** ANGLE_OCTAVES[coarser]
        image = np.ascontiguousarray(space.level(space.smooth, coarser)[::step, ::step])
        pixels = np.rint(candidates.xy[own] / pixel).astype(np.int64)
        windows = np.full(len(pixels), WINDOW_PER_LEVEL * SIGMAS_PX[level] / pixel)
        angles[own] = strongest_directions(image, pixels, windows)
    return angles


def ranking_logits(scores: np.ndarray) -> np.ndarray:
    """Return the (N,) float32 logits of scores above 0, up to rounding (see `ranking_scores`)."""
    tail = np.minimum(scores, 1 - scores).clip(np.finfo(np.float32).tiny)
    return np.copysign(0.5 / tail - 1, scores - 0.5).astype(np.float32)


def ranking_scores(logits: np.ndarray) -> np.ndarray:
    """Map (N,) float32 logits in descending order to strictly descending scores in (0, 1).

    If rounding makes two scores equal, the later one gets the next lower float32 number.
    """
    tail = 0.5 / (1 + np.abs(logits))
    scores = np.where(logits < 0, tail, 1 - tail).astype(np.float32)
    # The bits of positive floats have the same order as the numbers.
    place = np.arange(len(scores), dtype=np.int32)
    return (np.minimum.accumulate(scores.view(np.int32) + place) - place).view(np.float32)
