from __future__ import annotations

import numpy as np

from deepdetect.evaluation.metrics import stereo_score
from deepdetect.evaluation.metrics.stereo_matches import score_errors


def test_known_answers() -> None:
    disparity = np.full((4, 10), 3.0, np.float32)
    disparity[2] = np.nan
    points0 = np.array([[5, 0], [5, 1], [5, 1], [5, 2], [9, 3]])
    points1 = np.array([[2, 0], [3, 1], [3.1, 1], [2, 2], [6, 1]])
    score = stereo_score(points0, points1, disparity)
    # Right, right by exactly one pixel, wrong by 1.1, not judged, wrong by two rows.
    assert (score.matches, score.judged, score.right) == (5, 4, 2)
    assert score.share == 0.5


def test_no_match_is_no_error() -> None:
    assert score_errors(np.zeros(0)).share == 0
    assert score_errors(np.array([np.nan])).share == 0
