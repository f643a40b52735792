"""Tentative matches of a pair: sparse keypoints, matched by descriptors before any geometry."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ...detector.points.descriptor import describe_learned
from ...features.keypoints import Keypoints
from ...features.learned import is_learned, match_learned
from ...features.matchers import exact_neighbours, match_descriptors
from ...features.sift import detect_sift
from ...geometry.images import downscale
from ...geometry.transforms import scaled_points, transfer_errors
from ...geometry.two_view import GUIDING_THRESHOLDS_PX

Pair = tuple[np.ndarray, np.ndarray]
"""Two arrays, one per image: images, (H, W) uint8 luma, or positions of matches, (M, 2) each."""

MAX_SIDE_PX = 1200
"""Images with a longer side are scaled down to it, because the initial geometry may be coarse.
Chosen by hand."""

MAX_KEYPOINTS = 4000
"""Maximum number of keypoints that are detected in each image. Chosen by hand."""

MIN_POINTS = 1000
"""Multi-scale keypoints of the caller replace SIFT if each image has this many. Chosen by hand."""

MAX_RATIOS = (0.85, 0.8)
"""Limits of the ratio test, tried in this order. The second limit gives fewer matches but a smaller
fraction of wrong ones, so it may show a geometry that the first does not show. Chosen by hand."""

MIN_SEPARATION_PX = 2.0
"""Only one match per square cell of this side is kept in each image. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class TentativeMatches:
    """Sparse matches of two images, before any geometry.

    Attributes:
        views: both images as uint8 luma, scaled down if they are large.
        scales: scales of the views relative to the full-size images, at most 1.
        features: keypoints of the views, with their descriptors.
        matched: (M, 2) positions of the matches in each view.
        ratios: (M,) ratios of the descriptor distances to the best and to the second-best match.
    """

    views: tuple[np.ndarray, np.ndarray]
    scales: tuple[float, float]
    features: tuple[Keypoints, Keypoints]
    matched: Pair
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
        views, scales, features = self.views[::-1], self.scales[::-1], self.features[::-1]
        return TentativeMatches(views, scales, features, self.matched[::-1], self.ratios)

    def apart_from(self, homography: np.ndarray) -> TentativeMatches:
        """Return the matches that do not agree with a homography between the full-size images."""
        errors = transfer_errors(self.points0, self.points1, homography)
        left = errors > GUIDING_THRESHOLDS_PX["homography"] / self.scales[1]
        matched = self.matched[0][left], self.matched[1][left]
        return replace(self, matched=matched, ratios=self.ratios[left])


def find_tentative_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    features: tuple[Keypoints, Keypoints] | None = None,
    *,
    max_side_px: int = MAX_SIDE_PX,
    max_keypoints: int = MAX_KEYPOINTS,
) -> TentativeMatches:
    """Match sparse keypoints of two images; keep mutual neighbours that pass the ratio test.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        features: keypoints of both images with their descriptors, at positions in the images that
            are scaled down to `max_side_px`. None: SIFT keypoints are detected.
        max_side_px: images with a longer side are scaled down to it.
        max_keypoints: maximum number of keypoints that are detected in each image.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> matches = find_tentative_matches(image, image)
        >>> bool((matches.points0 == matches.points1).all()), len(matches.points0) > 10
        (True, True)
    """
    (view0, scale0), (view1, scale1) = (downscale(gray, max_side_px) for gray in (gray0, gray1))
    if features is None:
        with ThreadPoolExecutor(2) as pool:  # OpenCV's SIFT leaves a second processor idle
            of_first = pool.submit(detect_sift, view0, max_keypoints)
            of_second = detect_sift(view1, max_keypoints)
            features = of_first.result(), of_second
    points0, points1, ratios = match_sparse(*features)
    return TentativeMatches((view0, view1), (scale0, scale1), features, (points0, points1), ratios)


def matches_of_points(grays: Pair, points: tuple[Keypoints, Keypoints]) -> TentativeMatches | None:
    """Match the best multi-scale keypoints that the caller gives, with learned descriptors.

    In different light or under blur, they give two to five times as many correct matches as SIFT.
    Returns None if an image has fewer than `MIN_POINTS`, or if sizes or angles are missing.
    """
    if min(len(each) for each in points) < MIN_POINTS:
        return None
    described = []
    for gray, each in zip(grays, points, strict=True):
        if each.sizes is None or each.angles is None:
            return None
        view, scale = downscale(gray, MAX_SIDE_PX)
        best = describe_learned(view, each[:MAX_KEYPOINTS])
        xy, size = scaled_points(best.xy, scale), (view.shape[1], view.shape[0])
        described.append(replace(best, xy=xy, image_size=size))
    features = described[0], described[1]
    return find_tentative_matches(*grays, features, max_side_px=MAX_SIDE_PX)


def match_sparse(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, ...]:
    """Match keypoints by descriptors; return positions in both images, and distance ratios."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    match = partial(match_descriptors, matcher=exact_neighbours, ratio=max(MAX_RATIOS), mutual=True)
    if is_learned(first.descriptor_type):
        matches = match_learned(first, second, match)
    else:
        matches = match(first.descriptors, second.descriptors)
    return separate(first.xy[matches.indices0], second.xy[matches.indices1], matches.ratios)


def separate(*matches: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keep only one of several matches that start, or that end, at the same place.

    One corner that is found in many views is no further evidence. The first two arrays are the
    positions in both images; the other arrays are filtered with them.
    """
    for side in (0, 1):
        cells = np.rint(matches[side] / MIN_SEPARATION_PX)
        _, kept = np.unique(cells, axis=0, return_index=True)
        kept.sort()
        matches = tuple(values[kept] for values in matches)
    return matches


def checked_positions(points: Any) -> Pair:
    """Check sparse matches of another matcher; return two (K, 2) float64 arrays of positions."""
    try:
        points0, points1 = (np.array(each, np.float64) for each in points)
    except (TypeError, ValueError):
        points0 = points1 = np.empty(0)
    if points0.ndim != 2 or points0.shape[1:] != (2,) or points0.shape != points1.shape:
        raise OptionError(
            "tentative matches must be two arrays of shape (K, 2): positions in both images"
        )
    if not (np.isfinite(points0).all() and np.isfinite(points1).all()):
        raise OptionError("tentative matches must be finite positions: leave out all other matches")
    return points0, points1
