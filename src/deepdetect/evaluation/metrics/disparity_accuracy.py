"""Points of a rectified pair, judged by the true disparity: exactness, completeness, F-score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TOLERANCES = (0.5, 1.0, 2.0, 4.0)
"""Pixels of disparity."""


@dataclass(frozen=True)
class DisparityAccuracy:
    """Points judged by the true disparity.

    Attributes:
        points: their number.
        judged: those of them whose true disparity is known.
        within: share of the judged at most 0.5, 1, 2 and 4 px off; NaN without any.
        mean_error: of the judged, in pixels.
        completeness: share of the pixels with known truth, hidden ones too, that have a point
            at most 1 px off.
    """

    points: int
    judged: int
    within: tuple[float, ...]
    mean_error: float
    completeness: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of the share within 1 px and the completeness; 0 when both are."""
        share, complete = self.within[TOLERANCES.index(1.0)], self.completeness
        return 2 * share * complete / (share + complete) if share + complete > 0 else 0.0


def disparity_accuracy(
    pixels: np.ndarray, disparity: np.ndarray, truth: np.ndarray
) -> DisparityAccuracy:
    """Judge points.

    Args:
        pixels: (N, 2) positions in the left image; the truth is read at the nearest pixel.
        disparity: (N,) in pixels.
        truth: (H, W) true disparity of the left image, NaN where it is unknown.

    Example:
        >>> truth = np.array([[5.0, 5.0, np.nan, 7.0]])
        >>> found = disparity_accuracy([[0, 0], [1, 0], [2, 0]], np.array([5.2, 8, 1]), truth)
        >>> found.judged, found.within, round(found.completeness, 3), round(found.f_score, 3)
        (2, (0.5, 0.5, 0.5, 1.0), 0.333, 0.4)
    """
    columns, rows = np.rint(np.asarray(pixels, np.float64).reshape(-1, 2)).astype(np.int64).T
    height, width = truth.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows = columns[inside], rows[inside]
    errors = np.abs(np.asarray(disparity, np.float64)[inside] - truth[rows, columns])
    known = np.isfinite(errors)
    right = np.zeros(truth.shape, bool)  # each pixel once, however many points it has
    near = errors[known]
    good = np.flatnonzero(known)[near <= 1]
    right[rows[good], columns[good]] = True
    within = tuple(
        float((near <= tolerance).mean()) if len(near) else np.nan for tolerance in TOLERANCES
    )
    knowable = np.isfinite(truth).sum()
    return DisparityAccuracy(
        len(inside),
        int(known.sum()),
        within,
        float(near.mean()) if len(near) else np.nan,
        float(right.sum() / knowable) if knowable else np.nan,
    )
