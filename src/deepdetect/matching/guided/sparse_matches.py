"""Sparse matches of a pair, which an initial geometry is estimated from."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ...features.keypoints import Keypoints
from ...features.matchers import get_matcher, match_descriptors
from ...features.sift import describe_keypoints
from ...features.sift_detector import detect_sift
from ...geometry.rescaling import downscale, scaled_points
from .options import InitialGeometryOptions

Points = tuple[np.ndarray, np.ndarray]


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


def tentative_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    features: tuple[Keypoints, Keypoints] | None = None,
    options: InitialGeometryOptions = InitialGeometryOptions(),
) -> TentativeMatches:
    """Match sparse SIFT keypoints of two images, exactly, mutually and by the ratio test.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        features: keypoints of both images, scaled down where they are large, with their
            descriptors; None: they are detected.
        options: how many keypoints, at which size, and the ratio.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> found = tentative_matches(image, image)
        >>> bool((found.points0 == found.points1).all()), len(found.points0) > 10
        (True, True)
    """
    view0, scale0 = downscale(gray0, options.max_side_px)
    view1, scale1 = downscale(gray1, options.max_side_px)
    if features is None:
        with ThreadPoolExecutor(2) as pool:  # OpenCV's SIFT leaves a second processor idle
            of_first = pool.submit(detect_sift, view0, options.sift)
            of_second = detect_sift(view1, options.sift)
            features = of_first.result(), of_second
    points0, points1, ratios = match_features(features[0], features[1], options)
    return TentativeMatches((view0, view1), (scale0, scale1), features, (points0, points1), ratios)


def matches_of_points(
    gray0: np.ndarray,
    gray1: np.ndarray,
    points: tuple[Keypoints, Keypoints],
    options: InitialGeometryOptions = InitialGeometryOptions(),
) -> TentativeMatches | None:
    """Match points of all scales, described at their own sizes and angles, as sparse keypoints.

    Of two photographs in unlike light, or of which one is blurred, they give two to five times as
    many correct matches as SIFT's keypoints.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        points: keypoints of both images, best first.
        options: how many of them, and the ratio.

    Returns:
        The matches; None where there are too few points, or they have no sizes and angles.
    """
    if min(len(each) for each in points) < options.min_points:
        return None
    described = []
    for gray, each in zip((gray0, gray1), points, strict=True):
        if each.sizes is None or each.angles is None:
            return None
        best = describe_keypoints(gray, each[: options.sift.max_keypoints])
        scale = min(1.0, options.max_side_px / max(gray.shape))
        described.append(replace(best, xy=scaled_points(best.xy, scale)))
    return tentative_matches(gray0, gray1, (described[0], described[1]), options)


def match_features(
    first: Keypoints, second: Keypoints, options: InitialGeometryOptions
) -> tuple[np.ndarray, ...]:
    """Return matched positions in both images, and the ratios of the ratio test."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    found = match_descriptors(
        first.descriptors,
        second.descriptors,
        get_matcher("exact"),
        ratio=max(options.max_ratios),
        mutual=True,
    )
    points0, points1 = first.xy[found.indices0], second.xy[found.indices1]
    return separate(points0, points1, found.ratios, min_separation_px=options.min_separation_px)


def separate(*matches: np.ndarray, min_separation_px: float) -> tuple[np.ndarray, ...]:
    """Keep each place once in each image: one corner in many views is no further evidence.

    The first two arrays are the positions in both images; others are kept like them.
    """
    for side in (0, 1):
        places = np.rint(matches[side] / min_separation_px)
        _, kept = np.unique(places, axis=0, return_index=True)
        kept.sort()
        matches = tuple(values[kept] for values in matches)
    return matches
