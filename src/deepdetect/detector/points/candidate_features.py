"""Features of candidate keypoints, which are the input of the ranker.

The features are relative to the candidate's own scale and strength. They hardly change if the image
is rotated, zoomed or lit differently, so the same points rank high in both images of a pair.
"""

from __future__ import annotations

import numpy as np

from ..._shared.machine import parallel_for
from .hessian_scales import OCTAVES, SIGMAS_PX, VARIANCES, Candidates, ScaleSpace

RING_RADII, RING_POINTS = (1.0, 2.0, 3.5, 6.0), 8
"""Radii of the rings of samples around a candidate, in sigmas of its scale, and number of points on
each ring, at equal angles. Chosen by hand."""

FEATURES = 23 + 8 * len(RING_RADII)
DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR = map(np.float32, (1e-7, 1e-6, 1e-8))
"""The first two floors are added to |det Hessian| and to squared gradients before logarithms, the
third to |det Hessian| before its root divides features: all damp noise. Chosen by hand."""


def ring_offsets() -> np.ndarray:
    """Return the offsets from a candidate to its P ring points, (2, L, 2, P) int64.

    They are in pixels of the candidate's level. The first axis is x or y. The second is the level.
    The third tells whether the candidate's column (for x) or row (for y) is even or odd. The fourth
    is the ring point: the first points of all rings, then the second points, and so on.
    """
    angle = np.arange(RING_POINTS)[:, None] * (2 * np.pi / RING_POINTS)
    reach = (SIGMAS_PX / 2.0**OCTAVES)[:, None, None, None] * RING_RADII
    odd = np.arange(2)[:, None, None]  # halves are rounded to even columns and rows
    rings = [np.rint(reach * turn(angle) + odd) - odd for turn in (np.cos, np.sin)]
    return np.array(rings, np.int64).reshape(2, len(SIGMAS_PX), 2, -1)


def describe_candidates(space: ScaleSpace, candidates: Candidates) -> np.ndarray:
    """Compute the (N, `FEATURES`) float32 features of candidates.

    The first feature is the scaled logarithm of |det Hessian|. The others are, in this order:
    - |det Hessian| one level finer and one and two levels coarser, relative to the candidate's own;
    - the sign of det Hessian, which tells blobs from saddles;
    - the trace of the Hessian with and without its sign, at these levels and the candidate's own;
    - the squared gradient at the same four levels;
    - the grey value at the candidate's level;
    - the largest |det Hessian| nearby at the three levels, relative to that at the candidate;
    - for each ring, mean, maximum and minimum of |det Hessian| and of the grey value, and mean and
      maximum of the squared gradient;
    - the rank by |det Hessian|, divided by the number of pixels, and the level.
    """
    from .kernels import measure_candidates

    pixels = np.stack([candidates.level, candidates.row, candidates.column], 1)
    floors = DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR
    features = np.empty((len(candidates), FEATURES), np.float32)
    maps = space.smooth, space.response, space.layout, OCTAVES, VARIANCES
    given = *maps, ring_offsets(), pixels, floors, features
    parallel_for(len(candidates), measure_candidates, *given)
    features[:, 17] += 2 * space.gray - 1
    features[:, -2] = np.log((candidates.rank + 1) / space.layout[0, 1:].prod()) / 2 + 3
    features[:, -1] = (candidates.level - 4) / 3
    return features
