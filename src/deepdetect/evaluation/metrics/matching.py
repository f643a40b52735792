"""How many matches are correct (Mikolajczyk's matching score, D2-Net's matching accuracy)."""

from __future__ import annotations

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

    def precision(self, threshold: int) -> float:
        """Fraction of the matches within 1 to 10 px; its mean over pairs is the MMA."""
        return self.correct[threshold - 1] / self.matches if self.matches else 0.0

    def matching_score(self, threshold: int) -> float:
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
    """Evaluate (M, 2) matched positions of two images beside all (N, 2) keypoints of both."""
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
