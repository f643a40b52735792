"""How many matches are correct (Mikolajczyk's matching score, D2-Net's matching accuracy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...geometry.transforms import transfer_errors
from .homography import Sizes, project_visible

THRESHOLDS_PX = tuple(range(1, 11))
"""Of the mean matching accuracy."""


@dataclass(frozen=True)
class MatchAccuracy:
    """The matches of a pair, evaluated by its true homography.

    Attributes:
        matches: their number.
        correct: how many are at most 1, 2, ..., 10 px off, in the second image.
        visible: keypoints that the other image shows too, of the image that has fewer of them.
        correct_visible: as `correct`, of the matches whose two points both images show.
    """

    matches: int
    correct: tuple[int, ...]
    visible: int
    correct_visible: tuple[int, ...]

    @property
    def accuracy(self) -> tuple[float, ...]:
        """Fraction of the matches at most 1, 2, ..., 10 px off; zeros when there are none.

        The mean over pairs is the mean matching accuracy.
        """
        return tuple(count / self.matches if self.matches else 0.0 for count in self.correct)

    def precision(self, threshold: int = 3) -> float:
        """Fraction of the matches that are correct, at a threshold from 1 to 10 px."""
        return self.accuracy[threshold - 1]

    def matching_score(self, threshold: int = 3) -> float:
        """Correct matches over the keypoints that could have one."""
        return self.correct_visible[threshold - 1] / self.visible if self.visible else 0.0


def match_accuracy(
    points0: np.ndarray,
    points1: np.ndarray,
    keypoints0: np.ndarray,
    keypoints1: np.ndarray,
    homography: np.ndarray,
    sizes: Sizes,
) -> MatchAccuracy:
    """Evaluate matches.

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

    def visible(points: np.ndarray, matrix: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return np.isfinite(project_visible(points, matrix, size)[:, 0])

    fewest = min(
        visible(keypoints0, homography, sizes[1]).sum(), visible(keypoints1, back, sizes[0]).sum()
    )
    both = visible(points0, homography, sizes[1]) & visible(points1, back, sizes[0])
    correct = tuple(int((errors <= threshold).sum()) for threshold in THRESHOLDS_PX)
    correct_visible = tuple(int((errors[both] <= threshold).sum()) for threshold in THRESHOLDS_PX)
    return MatchAccuracy(len(errors), correct, int(fewest), correct_visible)


def mean_matching_accuracy(pairs: Sequence[MatchAccuracy]) -> tuple[float, ...]:
    """Average the accuracy over pairs, for 1, 2, ..., 10 px; a pair without matches counts as 0."""
    return tuple(float(value) for value in np.mean([pair.accuracy for pair in pairs], axis=0))
