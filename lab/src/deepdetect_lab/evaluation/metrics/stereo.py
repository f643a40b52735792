"""Evaluate matches and disparities of a rectified stereo pair by its true disparity map."""

from __future__ import annotations

import numpy as np

from deepdetect.geometry.transforms import TOLERANCE_PX, disparity_errors, score_errors

DISPARITY_TOLERANCES_PX = (0.5, 1.0, 2.0, 4.0)


def stereo_score(
    points0: np.ndarray, points1: np.ndarray, disparity: np.ndarray
) -> dict[str, float]:
    """Score (N, 2) matches by the left image's (H, W) true disparity, NaN where unknown."""
    return score_errors(disparity_errors(points0, points1, disparity))


def disparity_scores(
    pixels: np.ndarray, disparity: np.ndarray, truth: np.ndarray
) -> dict[str, float]:
    """Evaluate estimated disparities (N,) at pixels (N, 2) of the left image.

    `truth` is the true disparity map, (H, W), NaN where unknown. Returns values by column title.
    "1 - bad-t": fraction of the points with ground truth that have an error up to t pixels. "EPE":
    mean error of the points with ground truth. Completeness: fraction of the pixels with ground
    truth that have a point with an error up to 1 px. F-score: harmonic mean of "1 - bad-1" and
    completeness. Half-occluded: number of points whose true counterpart is outside the right image.
    The last value is the fraction of these points that have an error up to 1 px.
    """
    disparity = np.asarray(disparity, np.float64)
    columns, rows = np.rint(np.asarray(pixels, np.float64).reshape(-1, 2)).astype(np.int64).T
    height, width = truth.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows = columns[inside], rows[inside]
    true = truth[rows, columns]
    errors = np.abs(disparity[inside] - true)
    known = np.isfinite(errors)
    near = errors[known]
    accuracy = {t: _fraction(near <= t) for t in DISPARITY_TOLERANCES_PX}
    complete = np.zeros(truth.shape, bool)  # a pixel with several points counts once
    good = np.flatnonzero(known)[near <= TOLERANCE_PX]
    complete[rows[good], columns[good]] = True
    completeness = _fraction(complete[np.isfinite(truth)])
    both = accuracy[TOLERANCE_PX] + completeness
    counterpart = columns - true
    outside = (counterpart < -0.5) | (counterpart > width - 0.5)
    return {
        **{f"1 - bad-{tolerance:g}": share for tolerance, share in accuracy.items()},
        "EPE, px": float(near.mean()) if len(near) else np.nan,
        "completeness at 1 px": completeness,
        "F-score": 2 * accuracy[TOLERANCE_PX] * completeness / both if both > 0 else 0.0,
        "half-occluded, with a point": int(np.count_nonzero(outside)),
        "of these within 1 px": _fraction(errors[outside] <= TOLERANCE_PX),
    }


def _fraction(chosen: np.ndarray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan
