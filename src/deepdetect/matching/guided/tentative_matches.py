"""Tentative matches of a pair: sparse, before any geometry."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ...features.keypoints import Keypoints
from ...features.matchers import exact_neighbours, match_descriptors
from ...features.sift import describe_keypoints, detect_sift
from ...geometry.images import downscale
from ...geometry.transforms import scaled_points

Points = tuple[np.ndarray, np.ndarray]

MAX_SIDE_PX = 1200
"""Longer sides are scaled down to this: the initial geometry need not be fine."""

MAX_KEYPOINTS = 4000
"""Of SIFT in each image."""

MIN_POINTS = 1000
"""Where both images have at least so many points of all scales (a budget was asked for), these take
the place of SIFT's keypoints."""

MAX_RATIOS = (0.85, 0.8)
"""Of the ratio test, in the order in which they are tried: fewer matches, with fewer wrong ones
among them, may show what more do not."""

MIN_SEPARATION_PX = 2.0
"""Matches that begin or end nearer together than this count as one."""


@dataclass(frozen=True, eq=False)
class TentativeMatches:
    """Sparse matches of two images, before any geometry.

    Attributes:
        views: both images as uint8 luma, scaled down where they are large.
        scales: of the views, at most 1.
        features: SIFT keypoints of the views, with their descriptors.
        matched: (M, 2) positions in both views.
        ratios: (M,) of the ratio test.
    """

    views: tuple[np.ndarray, np.ndarray]
    scales: tuple[float, float]
    features: tuple[Keypoints, Keypoints]
    matched: Points
    ratios: np.ndarray

    @property
    def points0(self) -> np.ndarray:
        """Matched positions in the first image at its own size, (M, 2) float64."""
        return scaled_points(self.matched[0], 1 / self.scales[0])

    @property
    def points1(self) -> np.ndarray:
        """Matched positions in the second image at its own size, (M, 2) float64."""
        return scaled_points(self.matched[1], 1 / self.scales[1])

    def swapped(self) -> TentativeMatches:
        """Return the matches from the second image to the first."""
        return TentativeMatches(
            self.views[::-1],
            self.scales[::-1],
            self.features[::-1],
            self.matched[::-1],
            self.ratios,
        )


def find_tentative_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    features: tuple[Keypoints, Keypoints] | None = None,
    *,
    max_side_px: int = MAX_SIDE_PX,
    max_keypoints: int = MAX_KEYPOINTS,
) -> TentativeMatches:
    """Match sparse SIFT keypoints of two images, exactly, mutually and by the ratio test.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        features: keypoints of both images, scaled down where they are large, with their
            descriptors; None: they are detected.
        max_side_px: longer sides are scaled down to this.
        max_keypoints: that are detected in each image.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> found = find_tentative_matches(image, image)
        >>> bool((found.points0 == found.points1).all()), len(found.points0) > 10
        (True, True)
    """
    (view0, scale0), (view1, scale1) = (downscale(gray, max_side_px) for gray in (gray0, gray1))
    if features is None:
        sift = max_keypoints
        with ThreadPoolExecutor(2) as pool:  # OpenCV's SIFT leaves a second processor idle
            of_first = pool.submit(detect_sift, view0, sift)
            of_second = detect_sift(view1, sift)
            features = of_first.result(), of_second
    points0, points1, ratios = match_sparse(*features)
    return TentativeMatches((view0, view1), (scale0, scale1), features, (points0, points1), ratios)


def matches_of_points(
    gray0: np.ndarray, gray1: np.ndarray, points: tuple[Keypoints, Keypoints]
) -> TentativeMatches | None:
    """Match points of all scales, described at their own sizes and angles, as sparse keypoints.

    Of two images in unlike light, or of which one is blurred, they give two to five times as many
    correct matches as SIFT's keypoints.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        points: keypoints of both images, best first.

    Returns:
        The matches; None where there are too few points, or they have no sizes and angles.
    """
    if min(len(each) for each in points) < MIN_POINTS:
        return None
    described = []
    for gray, each in zip((gray0, gray1), points, strict=True):
        if each.sizes is None or each.angles is None:
            return None
        best = describe_keypoints(gray, each[:MAX_KEYPOINTS])
        scale = min(1.0, MAX_SIDE_PX / max(gray.shape))
        described.append(replace(best, xy=scaled_points(best.xy, scale)))
    features = described[0], described[1]
    return find_tentative_matches(gray0, gray1, features, max_side_px=MAX_SIDE_PX)


def match_sparse(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, ...]:
    """Return matched positions in both images, and the ratios of the ratio test."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    found = match_descriptors(
        first.descriptors,
        second.descriptors,
        exact_neighbours,
        ratio=max(MAX_RATIOS),
        mutual=True,
    )
    return separate(first.xy[found.indices0], second.xy[found.indices1], found.ratios)


def separate(*matches: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keep each place once in each image: one corner in many views is no further evidence.

    The first two arrays are the positions in both images; others are kept like them.
    """
    for side in (0, 1):
        places = np.rint(matches[side] / MIN_SEPARATION_PX)
        _, kept = np.unique(places, axis=0, return_index=True)
        kept.sort()
        matches = tuple(values[kept] for values in matches)
    return matches
