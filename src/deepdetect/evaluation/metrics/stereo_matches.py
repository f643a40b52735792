"""Matches of a rectified stereo pair, judged by its true disparity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...geometry import disparity_errors

TOLERANCE = 1.0
"""Distance from the true match, in pixels, up to which a match counts as right."""


@dataclass(frozen=True)
class StereoScore:
    """Matches judged by the true disparity.

    Attributes:
        matches: number of matches.
        judged: those of them whose true disparity is known.
        right: those of the judged that are within 1 px of it.
    """

    matches: int
    judged: int
    right: int

    @property
    def share(self) -> float:
        """Share of the judged matches that are right."""
        return self.right / self.judged if self.judged else 0.0


def stereo_score(points0: np.ndarray, points1: np.ndarray, disparity: np.ndarray) -> StereoScore:
    """Judge the matches of a rectified pair.

    Args:
        points0, points1: (N, 2) matched positions in the left and the right image, x right and
            y down, centre of the first pixel (0, 0).
        disparity: (H, W) true disparity of the left image in pixels, NaN where it is unknown.

    Example:
        >>> stereo_score([[5, 0], [6, 0], [7, 0]], [[3, 0], [3, 0], [7, 0]], np.full((1, 8), 2.0))
        StereoScore(matches=3, judged=3, right=2)
    """
    return score_errors(disparity_errors(points0, points1, disparity))


def score_errors(errors: np.ndarray) -> StereoScore:
    """Count the errors of `disparity_errors` that are known and at most `TOLERANCE`."""
    known = np.isfinite(errors)
    return StereoScore(len(errors), int(known.sum()), int((errors[known] <= TOLERANCE).sum()))
