"""What the ranker knows about a candidate: measurements relative to its own scale and strength.

They hardly change when the image is turned, zoomed or lit otherwise, so a ranking by them holds in
both images of a pair.
"""

from __future__ import annotations

import numpy as np

from .hessian_scales import Candidates, ScaleSpace

RING_RADII = (1.0, 2.0, 3.5, 6.0)
"""Of the rings around a candidate that are looked at, in sigmas."""

RING_POINTS = 8
FEATURES = 23 + 8 * len(RING_RADII)
"""Number of features of a candidate."""

_NEIGHBORS = (-1, 1, 2)
"""Levels that are compared with a candidate's own."""

DETERMINANT_FLOOR, GRADIENT_FLOOR, STRENGTH_FLOOR = 1e-7, 1e-6, 1e-8
"""Added before logarithms and divisions: responses of noise and rounding look like nothing."""


def describe_candidates(
    space: ScaleSpace, candidates: Candidates, rows: np.ndarray | None = None
) -> np.ndarray:
    """Compute the (N, `FEATURES`) float32 features of candidates, or of some rows of them.

    The first is the logarithm of |det Hessian|, scaled. The others are: the same at neighbouring
    scales and the largest nearby there, relative to it; whether the candidate is a blob or a
    saddle; trace, gradient and grey value; mean, largest and smallest of |det Hessian|, grey value
    and gradient on rings; its rank among all candidates per pixel; its level.
    """
    levels, height, width = space.smooth.shape
    rank = np.empty(len(candidates), np.int64)
    strongest = np.argsort(-candidates.strength(space), kind="stable")
    rank[strongest] = np.arange(len(candidates))
    if rows is not None:
        candidates, rank = candidates[rows], rank[rows]
    determinant, trace, gradient, smooth, highest = (
        maps.reshape(-1)
        for maps in (space.determinant, space.trace, space.gradient, space.smooth, space.highest)
    )
    pixel = candidates.row * width + candidates.column
    plane = height * width

    def log_determinant(values: np.ndarray) -> np.ndarray:
        return np.log(np.abs(values) + np.float32(DETERMINANT_FLOOR))

    def log_gradient(values: np.ndarray) -> np.ndarray:
        return np.log(values + np.float32(GRADIENT_FLOOR)) / 2

    def beside(step: int) -> np.ndarray:
        return np.clip(candidates.level + step, 0, levels - 1) * plane + pixel

    here = beside(0)
    own = log_determinant(determinant[here])
    strength = np.sqrt(np.abs(determinant[here]) + np.float32(STRENGTH_FLOOR))
    columns = [(own + 9) / 3]
    columns += [(log_determinant(determinant[beside(k)]) - own) / 2 for k in _NEIGHBORS]
    columns.append(np.sign(determinant[here]))
    for k in (-1, 0, 1, 2):
        bent = np.arctan(trace[beside(k)] / strength / 2)
        columns += [bent, np.abs(bent)]
    columns += [(log_gradient(gradient[beside(k)]) - own / 2) / 2 for k in (-1, 0, 1, 2)]
    columns.append(2 * smooth[here] - 1)
    columns += [
        (log_determinant(highest[beside(k)]) - log_determinant(determinant[beside(k)])) / 2
        for k in _NEIGHBORS
    ]
    angle = np.arange(RING_POINTS) * (2 * np.pi / RING_POINTS)
    for radius in RING_RADII:
        reach = radius * candidates.sigma_px[:, None]
        x = np.rint(candidates.column[:, None] + reach * np.cos(angle)).astype(np.int64)
        y = np.rint(candidates.row[:, None] + reach * np.sin(angle)).astype(np.int64)
        ring = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)
        ring += (candidates.level * plane)[:, None]
        response = log_determinant(determinant[ring]) - own[:, None]
        light = (smooth[ring] - smooth[here][:, None]) / strength[:, None]
        slope = log_gradient(gradient[ring]) - own[:, None] / 2
        columns += [response.mean(1) / 2, response.max(1) / 2, response.min(1) / 4]
        columns += [np.arctan(each / 2) for each in (light.mean(1), light.max(1), light.min(1))]
        columns += [slope.mean(1) / 2, slope.max(1) / 2]
    columns.append(np.log((rank + 1) / plane) / 2 + 3)
    columns.append((candidates.level - 4) / 3)
    return np.stack(columns, 1).astype(np.float32)
