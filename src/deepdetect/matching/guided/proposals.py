"""Hypotheses about the geometry of a pair, from sparse matches of several sources.

A source finds tentative matches; many of them may be wrong. Homographies and a fundamental matrix
are estimated from them. Sources are asked in turn, the cheapest first, until the images confirm a
hypothesis.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np

from ...detector.point_detector import PointDetector
from ...detector.points.descriptor import describe_learned
from ...features.keypoints import Keypoints
from ...features.learned import CROSS_MODAL, LEARNED, is_learned, match_learned, ratio_limit
from ...features.matchers import exact_neighbours, match_descriptors
from ...geometry.refinement import refine_fundamental
from ...geometry.transforms import epipolar_errors, scaled_points, transfer_errors
from ...geometry.two_view import GUIDING_THRESHOLDS_PX, fit_model
from ...io.image import MINIMUM_SIDE
from .image_pair import ImagePair, Pair
from .simulated_views import simulated_views

LEARNED_SIDE_PX, LEARNED_KEYPOINTS = 640, 2048
"""The first matches come from images of this longer side, with this number of points in each.
These points gave 655 of the 796 right answers for the 1,050 test pairs of `lab/acceptance`."""

DENSE_SIDE_PX, DENSE_KEYPOINTS = 1280, 8192
"""If the images confirm no geometry of the first matches, this number of points is found in images
of this longer side. That gave 25 more of the 796 right answers of `lab/acceptance`."""

GIVEN_SIDE_PX = 1200
"""Matches that the caller gives are assumed to be as exact as in images of this longer side."""

VIEWED_SIDE_PX, VIEWED_KEYPOINTS = 320, 1000
"""Each image, with this longer side and number of points, is compared with 8 oblique views of the
other, each with half as many points. The 16 views then take as long as DENSE_KEYPOINTS points."""

TENTATIVE_RATIO = 0.95
"""Limit of the ratio test of learned descriptors for tentative matches. It is loose, because each
geometry is later compared with the pixels. On the ten pairs of the data set `wide`, with wide
baselines or changes of light, limits of 0.91, 0.93, 0.94, 0.95 and 0.97 give an mAA at 10 px of
0.38, 0.44, 0.36, 0.47 and 0.43."""

SEPARATION_PX = 2.0
"""Only one match per square of this side is kept in each image, in pixels of the reduced images,
because one corner that is found twice is no further evidence."""

MAX_PLANES = 3
"""Maximum number of homographies that are tried, each from the matches that fit none before. On a
facade, two may be wrong by one window, one in either direction."""

MIN_MATCHES = 8
"""A geometry needs this many matches, because a fundamental matrix fits any seven."""


@dataclass(frozen=True, eq=False)
class Tentative:
    """Sparse matches of one source.

    Attributes:
        points0, points1: (M, 2) float64 positions in the images at their own sizes.
        pixel: pixels of the second image per pixel of the copy in which the matches were found.
        cross_modal: whether the descriptors are for images of two sensors.
        views: number of simulated oblique views that were compared; 0 if none.
    """

    points0: np.ndarray
    points1: np.ndarray
    pixel: float = 1.0
    cross_modal: bool = False
    views: int = 0

    def chosen(self, rows: np.ndarray) -> Tentative:
        """Return the matches that `rows`, a mask or indices, selects."""
        return replace(self, points0=self.points0[rows], points1=self.points1[rows])


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A geometry that tentative matches propose.

    Attributes:
        model: "homography" or "fundamental".
        matrix: (3, 3), from the first to the second image, in pixels at their own sizes.
        inliers: (M,) bool, the tentative matches that agree.
        log10_nfa: decimal logarithm of the expected number of such geometries among random matches.
        tentative: the matches.
    """

    model: str
    matrix: np.ndarray
    inliers: np.ndarray
    log10_nfa: float
    tentative: Tentative

    @property
    def points(self) -> Pair:
        """The matches that agree, (K, 2) in each image."""
        return self.tentative.points0[self.inliers], self.tentative.points1[self.inliers]

    @property
    def threshold_px(self) -> float:
        """Largest error of an inlier, in pixels of the second image."""
        return GUIDING_THRESHOLDS_PX[self.model] * self.tentative.pixel

    def refitted(self, pair: ImagePair, tracks: Pair) -> Hypothesis:
        """Return this fundamental matrix, fitted also to those of `tracks` that agree with it."""
        near = self.errors(*tracks) < self.threshold_px
        if np.count_nonzero(near) < MIN_MATCHES:
            return self
        sources = self.points, (tracks[0][near], tracks[1][near])
        return replace(self, matrix=refine_fundamental(sources, self.matrix, pair.sizes))

    def errors(self, points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
        """Return the (N,) transfer or Sampson errors of matches under the geometry, in pixels."""
        return (transfer_errors if self.model == "homography" else epipolar_errors)(
            points0, points1, self.matrix
        )


class Sources:
    """The sources of tentative matches of a pair, cheapest first; each computes them on demand."""

    def __init__(self, pair: ImagePair, given: Pair | None = None) -> None:
        self._pair, self._given = pair, given

    def __iter__(self) -> Iterator[Tentative]:
        if self._given is not None:
            yield self._of_positions(self._given)
        yield self.learned
        yield self.dense
        yield self._cross_modal()
        yield self._views()

    @cached_property
    def learned(self) -> Tentative:
        """Matches by learned descriptors in images reduced to the longer side `LEARNED_SIDE_PX`."""
        return self._matched(self._extract(LEARNED_SIDE_PX, LEARNED_KEYPOINTS), LEARNED_SIDE_PX)

    def _extract(self, side_px: int, keypoints: int) -> tuple[Keypoints, Keypoints]:
        pair = self._pair

        def extract(side: int) -> Keypoints:
            gray = pair.reduced(side, side_px)[0]
            return pair.once(side, (side_px, keypoints), lambda: learned_points(gray, keypoints))

        with ThreadPoolExecutor(2) as pool:
            first, second = pool.map(extract, (0, 1))
        return first, second

    def _matched(self, points: tuple[Keypoints, Keypoints], side_px: int) -> Tentative:
        (scale0, scale1) = self._pair.both(side_px)[1]
        points0, points1, _ = matched_points(*points)
        ends = scaled_points(points0, 1 / scale0), scaled_points(points1, 1 / scale1)
        return Tentative(*ends, 1 / scale1)

    def _cross_modal(self) -> Tentative:
        views, _ = self._pair.both(LEARNED_SIDE_PX)
        described = [
            describe_learned(view, points, CROSS_MODAL)
            for view, points in zip(
                views, self._extract(LEARNED_SIDE_PX, LEARNED_KEYPOINTS), strict=True
            )
        ]
        found = self._matched((described[0], described[1]), LEARNED_SIDE_PX)
        return replace(found, cross_modal=True)

    @cached_property
    def dense(self) -> Tentative:
        """Matches of `DENSE_KEYPOINTS` points in copies whose longer side is `DENSE_SIDE_PX`."""
        return self._matched(self._extract(DENSE_SIDE_PX, DENSE_KEYPOINTS), DENSE_SIDE_PX)

    def _views(self) -> Tentative:
        views, (scale0, scale1) = self._pair.both(VIEWED_SIDE_PX)
        points = self._extract(VIEWED_SIDE_PX, VIEWED_KEYPOINTS)
        find = partial(learned_points, max_keypoints=VIEWED_KEYPOINTS // 2)
        found, count = [matched_points(*points), *self._zoomed(points, scale0, scale1)], 0
        for side, seen in simulated_views(views, find):
            further = matched_points(seen, points[1 - side])
            found.append((further[side], further[1 - side], further[2]))
            count += 1
        points0, points1, _ = separate(*map(np.concatenate, zip(*found, strict=True)))
        ends = scaled_points(points0, 1 / scale0), scaled_points(points1, 1 / scale1)
        return Tentative(*ends, 1 / scale1, views=count)

    def _zoomed(
        self, points: tuple[Keypoints, Keypoints], scale0: float, scale1: float
    ) -> Iterator[tuple[np.ndarray, ...]]:
        """Yield matches of small copies of either image with large copies of the other."""
        large0, large1 = self._extract(DENSE_SIDE_PX, DENSE_KEYPOINTS)
        dense0, dense1 = self._pair.both(DENSE_SIDE_PX)[1]
        first, second, ratios = matched_points(points[0], large1)
        yield first, scaled_points(second, scale1 / dense1), ratios
        first, second, ratios = matched_points(large0, points[1])
        yield scaled_points(first, scale0 / dense0), second, ratios

    def _of_positions(self, positions: Pair) -> Tentative:
        scales = [min(1.0, GIVEN_SIDE_PX / max(size)) for size in self._pair.sizes]
        scaled = [scaled_points(p, s) for p, s in zip(positions, scales, strict=True)]
        kept = separate(*scaled, np.arange(len(scaled[0])))[2]
        return Tentative(positions[0][kept], positions[1][kept], 1 / scales[1])


def learned_points(gray: np.ndarray, max_keypoints: int) -> Keypoints:
    """Return keypoints with learned descriptors, or no keypoints if the image is too small."""
    height, width = gray.shape
    if min(height, width) < MINIMUM_SIDE:
        return describe_learned(gray, Keypoints.empty((width, height)))
    return _detector(max_keypoints).extract(gray)


@cache
def _detector(max_keypoints: int) -> PointDetector:
    return PointDetector(max_keypoints, descriptor=LEARNED)


def matched_points(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, ...]:
    """Match keypoints by descriptors; return positions in both images, and distance ratios."""
    assert first.descriptors is not None
    assert second.descriptors is not None
    kind = first.descriptor_type
    ratio = TENTATIVE_RATIO if kind in (LEARNED, CROSS_MODAL) else ratio_limit(kind)
    match = partial(match_descriptors, matcher=exact_neighbours, ratio=ratio, mutual=True)
    if is_learned(first.descriptor_type):
        matches, _ = match_learned(first, second, match)
    else:
        matches = match(first.descriptors, second.descriptors)
    points = first.xy[matches.indices0], second.xy[matches.indices1]
    return separate(*(each.astype(np.float64) for each in points), matches.ratios)


def separate(*matches: np.ndarray) -> tuple[np.ndarray, ...]:
    """Keep only one of several matches that start, or that end, at the same place.

    One corner that is found in many views is no further evidence. The first two arrays are the
    positions in both images; the other arrays are filtered with them.
    """
    for side in (0, 1):
        cells = np.rint(matches[side] / SEPARATION_PX)
        _, kept = np.unique(cells, axis=0, return_index=True)
        kept.sort()
        matches = tuple(values[kept] for values in matches)
    return matches


def planes(pair: ImagePair, tentative: Tentative, seed: int) -> Iterator[Hypothesis]:
    """Yield homographies that more matches agree with than chance explains, the best first."""
    left = np.ones(len(tentative.points0), bool)
    for _ in range(MAX_PLANES):
        rows = np.flatnonzero(left)
        if len(rows) < MIN_MATCHES:
            return
        some = tentative.chosen(rows)
        found = propose(pair, some, "homography", seed)
        if found is None:
            return
        inliers = np.zeros(len(left), bool)
        inliers[rows[found.inliers]] = True
        left &= ~inliers
        yield replace(found, inliers=inliers, tentative=tentative)


def propose(pair: ImagePair, tentative: Tentative, model: str, seed: int) -> Hypothesis | None:
    """Estimate a geometry of tentative matches; return None if chance explains them."""
    if len(tentative.points0) < MIN_MATCHES:
        return None
    ends, size = (tentative.points0, tentative.points1), pair.sizes[1]
    threshold_px = GUIDING_THRESHOLDS_PX[model] * tentative.pixel
    found = fit_model(*ends, model, size, threshold_px, seed)
    if found.matrix is None or not found.trusted:
        return None
    return Hypothesis(model, found.matrix, found.inliers, found.log10_nfa, tentative)
