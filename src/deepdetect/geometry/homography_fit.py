"""A homography fitted to many points, of which some are wrong."""

from __future__ import annotations

import numpy as np

from .transforms import transform_points

IRLS_ITERATIONS = 30
"""Maximum number of steps; a step that changes nothing ends the fit."""


def fit_homography_irls(
    points0: np.ndarray, points1: np.ndarray, scale_px: float = 1.0
) -> np.ndarray | None:
    """Fit a homography to (N, 2) points by iteratively reweighted least squares (Cauchy weights).

    A point with a residual of `scale_px` has half the weight of one without. Returns None if the
    points determine no homography. The last element of the result is 1.
    """
    middle = points0.mean(axis=0)
    spread = float(np.abs(points0 - middle).mean())
    if not spread > 0:
        return None
    inwards = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, spread]]) / spread
    first, second = ((points - middle) / spread for points in (points0, points1))
    homography = np.eye(3)
    for _ in range(IRLS_ITERATIONS):
        depth = first @ homography[2, :2] + 1
        mapped = transform_points(first, homography)
        gaps = second - mapped
        weight = 1 / (1 + (gaps**2).sum(axis=1) * (spread / scale_px) ** 2)
        position = np.column_stack([first, np.ones(len(first))]) / depth[:, None]
        zeros = np.zeros_like(position)
        across = np.column_stack([position, zeros, -mapped[:, :1] * position[:, :2]])
        down = np.column_stack([zeros, position, -mapped[:, 1:] * position[:, :2]])
        normal = (across.T * weight) @ across + (down.T * weight) @ down
        right = (across.T * weight) @ gaps[:, 0] + (down.T * weight) @ gaps[:, 1]
        try:
            step = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        homography = homography + np.append(step, 0).reshape(3, 3)
        if np.abs(step).max() < 1e-9:
            break
    homography = np.linalg.inv(inwards) @ homography @ inwards
    return homography / homography[2, 2]
