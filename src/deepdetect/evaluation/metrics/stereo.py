"""Matches and points of a rectified stereo pair, evaluated by its true disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry import disparity_errors

TOLERANCE_PX = 1.0
"""Distance from the true match up to which a match counts as correct."""

DISPARITY_TOLERANCES_PX = (0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class StereoScore:
    """Matches evaluated by the true disparity.

    Attributes:
        matches: number of matches.
        evaluated: those of them whose true disparity is known.
        correct: those of the evaluated that are within 1 px of it.
    """

    matches: int
    evaluated: int
    correct: int

    @property
    def precision(self) -> float:
        """Fraction of the evaluated matches that are correct."""
        return self.correct / self.evaluated if self.evaluated else 0.0


def stereo_score(points0: np.ndarray, points1: np.ndarray, disparity: np.ndarray) -> StereoScore:
    """Evaluate the matches of a rectified pair.

    Args:
        points0, points1: (N, 2) matched positions in the left and the right image, x right and
            y down, centre of the first pixel (0, 0).
        disparity: (H, W) true disparity of the left image in pixels, NaN where it is unknown.

    Example:
        >>> stereo_score([[5, 0], [6, 0], [7, 0]], [[3, 0], [3, 0], [7, 0]], np.full((1, 8), 2.0))
        StereoScore(matches=3, evaluated=3, correct=2)
    """
    return score_errors(disparity_errors(points0, points1, disparity))


def score_errors(errors: np.ndarray) -> StereoScore:
    """Count the errors of `disparity_errors` that are known and at most `TOLERANCE_PX`."""
    known = np.isfinite(errors)
    return StereoScore(len(errors), int(known.sum()), int((errors[known] <= TOLERANCE_PX).sum()))


@dataclass(frozen=True)
class DisparityAccuracy:
    """Points evaluated by the true disparity.

    Attributes:
        accuracy: fraction of those with a known truth at most 0.5, 1, 2 and 4 px off (1 - bad-0.5,
            ...); NaN without any.
        epe_px: their mean error (end-point error).
        completeness: fraction of the pixels with known truth, hidden ones too, that have a point
            at most 1 px off.
    """

    accuracy: tuple[float, ...]
    epe_px: float
    completeness: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of the accuracy at 1 px and the completeness; 0 when both are."""
        accuracy, complete = self.accuracy[DISPARITY_TOLERANCES_PX.index(1.0)], self.completeness
        return 2 * accuracy * complete / (accuracy + complete) if accuracy + complete > 0 else 0.0


def disparity_accuracy(
    pixels: np.ndarray, disparity: np.ndarray, truth: np.ndarray
) -> DisparityAccuracy:
    """Evaluate points.

    Args:
        pixels: (N, 2) positions in the left image; the truth is read at the nearest pixel.
        disparity: (N,) in pixels.
        truth: (H, W) true disparity of the left image, NaN where it is unknown.

    Example:
        >>> truth = np.array([[5.0, 5.0, np.nan, 7.0]])
        >>> found = disparity_accuracy([[0, 0], [1, 0], [2, 0]], np.array([5.2, 8, 1]), truth)
        >>> found.accuracy, round(found.completeness, 3), round(found.f_score, 3)
        ((0.5, 0.5, 0.5, 1.0), 0.333, 0.4)
    """
    columns, rows = np.rint(np.asarray(pixels, np.float64).reshape(-1, 2)).astype(np.int64).T
    height, width = truth.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows = columns[inside], rows[inside]
    errors = np.abs(np.asarray(disparity, np.float64)[inside] - truth[rows, columns])
    known = np.isfinite(errors)
    complete = np.zeros(truth.shape, bool)  # each pixel once, however many points it has
    near = errors[known]
    good = np.flatnonzero(known)[near <= 1]
    complete[rows[good], columns[good]] = True
    knowable = np.isfinite(truth).sum()
    return DisparityAccuracy(
        accuracy=tuple(
            float((near <= tolerance).mean()) if len(near) else np.nan
            for tolerance in DISPARITY_TOLERANCES_PX
        ),
        epe_px=float(near.mean()) if len(near) else np.nan,
        completeness=float(complete.sum() / knowable) if knowable else np.nan,
    )


def half_occluded_accuracy(
    pixels: np.ndarray, disparity: np.ndarray, truth: np.ndarray
) -> tuple[int, float]:
    """Evaluate the points at pixels whose counterpart lies outside the right image.

    Args:
        pixels: (N, 2) whole pixels of the left image, each once.
        disparity: (N,) in pixels.
        truth: (H, W) true disparity of the left image, NaN where it is unknown.

    Returns:
        Their number, and the fraction of them at most 1 px off, NaN without any.

    Example:
        >>> points = [[0, 0], [1, 0], [3, 0]]
        >>> half_occluded_accuracy(points, np.array([3.5, 9, 3]), np.full((1, 4), 3.0))
        (2, 0.5)
    """
    columns, rows = np.rint(np.asarray(pixels, np.float64).reshape(-1, 2)).astype(np.int64).T
    true = truth[rows, columns]
    counterpart = columns - true
    outside = (counterpart < -0.5) | (counterpart > truth.shape[1] - 0.5)
    errors = np.abs(np.asarray(disparity, np.float64) - true)[outside]
    return len(errors), float((errors <= TOLERANCE_PX).mean()) if len(errors) else np.nan
