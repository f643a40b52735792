"""Dense matches along a homography: it predicts the partner of every keypoint."""

from __future__ import annotations

import numpy as np

from ...features.keypoints import nearest_keypoints
from ...features.matches import GuidedMatches
from ...geometry.homography_refinement import refine_homography
from ...geometry.transforms import scaled_homography, transform_points
from .image_pair import ImagePair, Pair
from .judge import Evidence, Judge

MAX_DISTANCE_PX = 1.0
"""A keypoint of the second image may be a partner if it is nearer than this to the place where the
homography maps the keypoint of the first image: positions are whole pixels."""

MAX_REFINED_SIDE_PX = 1024
"""Images are reduced to this longer side while the homography is refined."""

MAX_SCALE_RATIO, MIN_SCALE = 1.5, 1 / 16
"""If the scales of the two images differ by more than the first factor, the finer image is scaled
down while the homography is refined, because corners of different scales lie at different places;
at most to the second."""


def refined(pair: ImagePair, homography: np.ndarray) -> np.ndarray:
    """Refine a homography by the content of both images."""
    scales = _scales_at_centre(homography, pair.sizes[0])
    (small0, scale0), (small1, scale1) = (
        pair.reduced(side, min(MAX_REFINED_SIDE_PX, round(max(size) * scale)))
        for side, (size, scale) in enumerate(zip(pair.sizes, scales, strict=True))
    )
    start = scaled_homography(homography, scale0, scale1)
    return scaled_homography(refine_homography(small0, small1, start), 1 / scale0, 1 / scale1)


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


def _scales_at_centre(homography: np.ndarray, size: tuple[int, int]) -> tuple[float, float]:
    """Return the factors by which to scale the images so that both show equally fine detail."""
    centre = np.array([size[0] / 2, size[1] / 2])
    around = transform_points(centre + [[0, 0], [1, 0], [0, 1]], homography)
    if not np.isfinite(around).all():
        return 1.0, 1.0
    largest, smallest = np.linalg.svd(around[1:] - around[0], compute_uv=False)
    if largest * MAX_SCALE_RATIO < 1:
        return max(float(largest), MIN_SCALE), 1.0
    if smallest > MAX_SCALE_RATIO:
        return 1.0, max(1 / float(smallest), MIN_SCALE)
    return 1.0, 1.0
