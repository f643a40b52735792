"""How many matches are right, and how far the others are off (Mikolajczyk; D2-Net's MMA)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.residuals import transfer_errors
from .overlap import map_into

THRESHOLDS = tuple(range(1, 11))
"""Pixels, of the mean matching accuracy."""


@dataclass(frozen=True)
class MatchAccuracy:
    """The matches of a pair, judged by its true homography.

    Attributes:
        matches: their number.
        correct: how many are at most 1, 2, ..., 10 px off, in the second image.
        seen: keypoints that the other image shows too, of the image that has fewer such.
        correct_seen: as `correct`, of the matches whose two points both images show.
    """

    matches: int
    correct: tuple[int, ...]
    seen: int
    correct_seen: tuple[int, ...]

    @property
    def accuracy(self) -> tuple[float, ...]:
        """Share of the matches at most 1, 2, ..., 10 px off; zeros when there are none.

        The mean over pairs is the mean matching accuracy.
        """
        return tuple(count / self.matches if self.matches else 0.0 for count in self.correct)

    def precision(self, threshold: int = 3) -> float:
        """Share of the matches that are right, at a threshold from 1 to 10 px."""
        return self.accuracy[threshold - 1]

    def matching_score(self, threshold: int = 3) -> float:
        """Right matches over the keypoints that could have one."""
        return self.correct_seen[threshold - 1] / self.seen if self.seen else 0.0


def match_accuracy(
    points0: np.ndarray,
    points1: np.ndarray,
    keypoints0: np.ndarray,
    keypoints1: np.ndarray,
    homography: np.ndarray,
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> MatchAccuracy:
    """Judge matches.

    Args:
        points0, points1: (M, 2) matched positions in both images.
        keypoints0, keypoints1: (N0, 2), (N1, 2) all keypoints of both.
        homography: (3, 3) from the first image to the second, the true one.
        sizes: (width, height) of both images.

    Example:
        >>> points = np.array([[1.0, 1], [2, 2], [3, 3], [4, 4]])
        >>> moved = points + [[0, 0], [0, 0], [1.5, 0], [0, 0]]
        >>> found = match_accuracy(points, moved, points, moved, np.eye(3), ((8, 8), (8, 8)))
        >>> found.accuracy[:2]
        (0.75, 1.0)
    """
    errors = transfer_errors(points0, points1, homography)
    back = np.linalg.inv(homography)

    def shown(points: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return np.isfinite(map_into(points, matrix, size)[:, 0])

    seen = min(
        shown(keypoints0, homography, sizes[1]).sum(), shown(keypoints1, back, sizes[0]).sum()
    )
    both = shown(points0, homography, sizes[1]) & shown(points1, back, sizes[0])
    correct = tuple(int((errors <= threshold).sum()) for threshold in THRESHOLDS)
    correct_seen = tuple(int((errors[both] <= threshold).sum()) for threshold in THRESHOLDS)
    return MatchAccuracy(len(errors), correct, int(seen), correct_seen)


def mean_matching_accuracy(pairs: Sequence[MatchAccuracy]) -> tuple[float, ...]:
    """Average the accuracy over pairs; a pair without matches counts as 0.

    Returns:
        For 1, 2, ..., 10 px.
    """
    return tuple(float(value) for value in np.mean([pair.accuracy for pair in pairs], axis=0))
