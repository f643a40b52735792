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
"""One array per image: both images, (H, W) uint8 luma, or matched positions, (M, 2) each."""

MAX_SIDE_PX = 1200
"""Images are reduced to this longer side: the initial geometry need not be fine. Chosen by hand."""

MAX_KEYPOINTS = 4000
"""Maximum number of keypoints of each image. Chosen by hand."""

MIN_POINTS = 1000
"""Points of all scales replace SIFT's keypoints if both images have at least this many, because the
user asked for a number of points. Chosen by hand."""

MAX_RATIOS = (0.85, 0.8)
"""Bounds of the ratio test, tried in this order: the second gives fewer matches, but fewer wrong
ones, and may show a geometry that the first does not show. Chosen by hand."""

MIN_SEPARATION_PX = 2.0
"""Matches that begin or end nearer together than this count as one. Chosen by hand."""


@dataclass(frozen=True, eq=False)
class TentativeMatches:
    """Sparse matches of two images, before any geometry.

    Attributes:
        views: both images as uint8 luma, scaled down if they are large.
        scales: scales of the views, at most 1.
        features: keypoints of the views, with their descriptors.
        matched: (M, 2) positions in both views.
        ratios: (M,) ratios of the distances to the best and to the second-best descriptor.
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
        """Return the matches that do not agree with a homography between the whole images."""
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
    """Match sparse SIFT keypoints of two images, exactly, mutually and by the ratio test.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        features: keypoints of both images, scaled down if these are large, with descriptors; None
            detects SIFT's keypoints.
        max_side_px: longer sides are scaled down to this.
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
    """Match the best points of all scales, at their own sizes and angles, as sparse keypoints.

    If the light of both images differs, or one is blurred, they give two to five times as many
    correct matches as SIFT's keypoints. None if there are too few, or they have no sizes or angles.
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
    """Return matched positions in both images, and their ratios from the ratio test."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    match = partial(match_descriptors, matcher=exact_neighbours, ratio=max(MAX_RATIOS), mutual=True)
    if is_learned(first.descriptor_type):
        matches = match_learned(first, second, match)
    else:
        matches = match(first.descriptors, second.descriptors)
    return separate(first.xy[matches.indices0], second.xy[matches.indices1], matches.ratios)


def separate(*matches: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keep each place once in each image: one corner in many views is no further evidence.

    The first two arrays are the positions in both images; the other arrays are filtered with them.
    """
    for side in (0, 1):
        cells = np.rint(matches[side] / MIN_SEPARATION_PX)
        _, kept = np.unique(cells, axis=0, return_index=True)
        kept.sort()
        matches = tuple(values[kept] for values in matches)
    return matches


def checked_positions(points: Any) -> Pair:
    """Return another matcher's sparse matches, two (K, 2) arrays of finite numbers, as float64."""
    try:
        points0, points1 = (np.array(each, np.float64) for each in points)
    except (TypeError, ValueError):
        points0 = points1 = np.empty(0)
    if points0.ndim != 2 or points0.shape[1:] != (2,) or points0.shape != points1.shape:
        raise OptionError(
            "tentative matches must be two arrays of shape (K, 2): positions in both images"
        )
    if not (np.isfinite(points0).all() and np.isfinite(points1).all()):
        raise OptionError("tentative matches must be finite positions: leave out the others")
    return points0, points1
