"""The features of a candidate for the ranker, relative to the candidate's own scale and strength.

They hardly change if the image is rotated, zoomed or lit differently, so that the ranker ranks the
same points high in both images of a pair.
"""

from __future__ import annotations

import numpy as np

from ..._shared.machine import parallel_for
from .hessian_scales import SIGMAS_PX, VARIANCES, Candidates, ScaleSpace

RING_RADII = (1.0, 2.0, 3.5, 6.0)
"""Radii of the rings that are sampled around a candidate, in sigmas. Chosen by hand."""

RING_POINTS = 8
"""Number of points on each ring, at equal angles. Chosen by hand."""

FEATURES = 23 + 8 * len(RING_RADII)
DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR = map(np.float32, (1e-7, 1e-6, 1e-8))
"""Values added to |det Hessian|, gradients and strengths before logarithms and divisions, so that
noise and rounding have little effect."""


def ring_offsets() -> np.ndarray:
    """Return the (2, L, 2, P) int64 offsets of all ring points, in pixels.

    The axes are x and y, the level, even or odd column (for y: row) of the candidate, and the
    points: first the first points of all rings, then the second ones, and so on.
    """
    angle = np.arange(RING_POINTS)[:, None] * (2 * np.pi / RING_POINTS)
    reach = SIGMAS_PX[:, None, None, None] * RING_RADII
    odd = np.arange(2)[:, None, None]  # halves round to even columns and rows
    rings = [np.rint(reach * turn(angle) + odd) - odd for turn in (np.cos, np.sin)]
    return np.array(rings, np.int64).reshape(2, len(SIGMAS_PX), 2, -1)


def describe_candidates(space: ScaleSpace, candidates: Candidates) -> np.ndarray:
    """Compute the (N, `FEATURES`) float32 features of candidates.

    The first is the scaled logarithm of |det Hessian|. The others are: the same at neighbouring
    scales (one level finer, one and two coarser); blob or saddle; trace and gradient at these
    scales and the candidate's own; its grey value; the largest |det Hessian| nearby at neighbouring
    scales, relative to its own; mean, maximum and minimum of |det Hessian|, grey value and gradient
    on rings; its rank divided by the number of pixels; its level.
    """
    from .kernels import measure_candidates

    pixels = np.stack([candidates.level, candidates.row, candidates.column], 1)
    floors = DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR
    features = np.empty((len(candidates), FEATURES), np.float32)
    parallel_for(
        len(candidates),
        measure_candidates,
        space.smooth.shape,
        *(maps.reshape(-1) for maps in (space.smooth, space.determinant)),
        VARIANCES,
        *(ring_offsets(), pixels, floors, features),
    )
    features[:, 17] += 2 * space.gray - 1
    features[:, -2] = np.log((candidates.rank + 1) / space.smooth[0].size) / 2 + 3
    features[:, -1] = (candidates.level - 4) / 3
    return features
