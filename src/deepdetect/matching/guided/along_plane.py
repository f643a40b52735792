"""Dense matches along a homography: it predicts the partner of every keypoint."""

from __future__ import annotations

import numpy as np

from ...features.keypoints import nearest_keypoints
from ...features.matches import GuidedMatches
from ...geometry.transforms import transform_points
from .image_pair import ImagePair, Pair
from .judge import Evidence, Judge

MAX_DISTANCE_PX = 1.0
"""A keypoint of the second image may be a partner if it is nearer than this to the place where the
homography maps the keypoint of the first image: positions are whole pixels."""


def match_along_plane(
    pair: ImagePair, pixels: Pair, homography: np.ndarray, judge: Judge, evidence: Evidence
) -> GuidedMatches:
    """Match keypoints on integer pixels, (N, 2) and (M, 2), where the evidence explains them."""
    predicted = transform_points(pixels[0], homography)
    indices1, distances = nearest_keypoints(predicted, pixels[1], pair.sizes[1])
    indices0 = np.flatnonzero(distances < MAX_DISTANCE_PX)
    cells = judge.cells_of(pixels[0][indices0])
    kept = evidence.believed[cells]
    indices0 = indices0[kept]
    indices1 = indices1[indices0]
    scores = np.nan_to_num(evidence.similarity[cells][kept], nan=evidence.bound).astype(np.float32)
    ends = pixels[1][indices1].astype(np.float64)
    return GuidedMatches(indices0, ends, scores.clip(0, 1), indices1=indices1)
