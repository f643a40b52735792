"""Dense matches of a plane or a rotating camera: the keypoint nearest to its predicted position."""

from __future__ import annotations

import numpy as np

from ...features.keypoints import nearest_keypoints
from ...features.matches import GuidedMatches
from ...geometry.homography_refinement import refine_homography
from ...geometry.images import downscale, warp_to_reference
from ...geometry.transforms import scaled_homography, transform_points
from .verification import dissimilarity

MAX_DISTANCE_PX = 1.0
"""From where the homography takes a keypoint to its partner."""

MIN_PROPOSED_FRACTION = 0.25
"""Where fewer of the keypoints that the second image shows under the homography have a partner
there, keypoints are few, and all of them are verified."""

MAX_VERIFIED_MEGAPIXELS = 6.0
"""Larger images are compared at this size, which bounds memory and time."""

MAX_REFINED_SIDE_PX = 1600
"""Longer sides are scaled down to this while the homography is refined."""

MAX_SCALE_RATIO = 1.5
"""Of the two images; where one shows the scene finer by more than this, it is scaled down to the
other for the refinement."""

MIN_SCALE = 1 / 16
"""Of one image in the other; beyond it a homography shows nothing that could be refined."""


def match_by_homography(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    homography: np.ndarray,
    seed: int = 0,
) -> tuple[GuidedMatches, float]:
    """Match keypoints by a homography, and keep those whose patches are the same.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        homography: (3, 3) from the first image to the second.
        seed: of the null pairs.

    Returns:
        The matches, their scores 1 less the `dissimilarity` of their patches; and the fraction
        with the same patches of the pairs that the homography proposes, or, where keypoints are
        few, of all keypoints of the first image that the second one shows under it. Each keypoint
        of the first image is matched once at most, those of the second image perhaps more often.
    """
    places = transform_points(xy0, homography)
    indices1, distances = nearest_keypoints(places, xy1, (gray1.shape[1], gray1.shape[0]))
    with np.errstate(invalid="ignore"):
        shown = (places > -0.5) & (places < np.array(gray1.shape[::-1]) - 0.5)
    near = distances < MAX_DISTANCE_PX
    indices0 = np.flatnonzero(shown.all(axis=1))
    proposed = np.flatnonzero(near)
    # Where keypoints are few it is chance which of them have another there: all are judged.
    if len(proposed) >= MIN_PROPOSED_FRACTION * len(indices0):
        indices0 = proposed
    ratios = _compare(gray0, gray1, xy0[indices0], homography, seed)
    same = ratios < 1
    kept = same & near[indices0]
    indices0 = indices0[kept]
    indices1 = indices1[indices0]
    scores = np.clip(1 - ratios[kept], 0, 1)
    found = GuidedMatches(indices0, xy1[indices1].astype(np.float64), scores, indices1=indices1)
    return found, float(same.mean()) if len(same) else 0.0


def _compare(
    gray0: np.ndarray, gray1: np.ndarray, pixels: np.ndarray, homography: np.ndarray, seed: int
) -> np.ndarray:
    """Return the `dissimilarity` of keypoints, of large images on smaller copies."""
    (gray0, scale0), (gray1, scale1) = (
        downscale(gray, round(max(gray.shape) * min(1, np.sqrt(MAX_VERIFIED_MEGAPIXELS / area))))
        for gray, area in ((each, each.size / 1e6) for each in (gray0, gray1))
    )
    if scale0 < 1 or scale1 < 1:
        homography = scaled_homography(homography, scale0, scale1)
        last = np.array(gray0.shape[::-1], np.float32) - 1
        pixels = np.clip(np.rint((pixels + np.float32(0.5)) * scale0 - 0.5), 0, last)
    warped, valid = warp_to_reference(gray1, homography, (gray0.shape[1], gray0.shape[0]))
    return dissimilarity(gray0, warped, valid, pixels, seed)


def refine_guiding_homography(
    gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray
) -> np.ndarray:
    """Refine a homography on the images, scaled down to what that needs; (3, 3).

    Where one image shows the scene much finer it is scaled down to the other: corners of different
    scales are not at the same place.
    """
    coarser0, coarser1 = _scales_at_centre(homography, gray0.shape)
    (small0, scale0), (small1, scale1) = (
        downscale(gray, min(MAX_REFINED_SIDE_PX, round(max(gray.shape) * scale)))
        for gray, scale in ((gray0, coarser0), (gray1, coarser1))
    )
    start = scaled_homography(homography, scale0, scale1)
    found = refine_homography(small0, small1, start)
    return scaled_homography(found, 1 / scale0, 1 / scale1)


def _scales_at_centre(homography: np.ndarray, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the scales of both images at which the finer one is as coarse as the other.

    Finer: in every direction, by more than `MAX_SCALE_RATIO`, in the middle of the first image.
    """
    centre = np.array([shape[1] / 2, shape[0] / 2])
    places = transform_points(centre + [[0, 0], [1, 0], [0, 1]], homography)
    if not np.isfinite(places).all():
        return 1.0, 1.0
    largest, smallest = np.linalg.svd(places[1:] - places[0], compute_uv=False)
    if largest * MAX_SCALE_RATIO < 1:
        return max(float(largest), MIN_SCALE), 1.0
    if smallest > MAX_SCALE_RATIO:
        return 1.0, max(1 / float(smallest), MIN_SCALE)
    return 1.0, 1.0
