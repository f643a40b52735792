"""The first look at a pair: a geometry from few points, or the word that none can be trusted.

Plain SIFT first; simulated views (`views`) only when that gives nothing. No keypoint of DeepDetect
takes part, and nothing of the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..._shared.errors import unknown_name
from ...features.keypoints import Keypoints
from ...features.matchers import get_matcher, match_descriptors
from ...features.sift_detector import SiftOptions, detect_sift
from ...geometry import GeometryOptions, estimate_geometry
from ...geometry.acontrario import MAX_LOG10_NFA, log10_nfa
from ...geometry.model_selection import select_model
from ...geometry.rescaling import downscale, scaled_fundamental, scaled_homography, scaled_points
from ...geometry.residuals import epipolar_errors, transfer_errors
from .asift import TILTS, tilted_views

LONGEST = 1200
"""Longer sides are shrunk to so many pixels: the first look need not be fine."""

RATIO = 0.85

PLACE = 2.0
"""Pixels; matches that begin or end nearer together are one."""

THRESHOLDS = {"homography": 3.0, "fundamental": 1.5}
"""Pixels (of the shrunk images) within which matches agree with a model."""


@dataclass(frozen=True, eq=False)
class FirstPass:
    """A geometry from few points.

    Attributes:
        kind: "homography", "fundamental", or "none" when no geometry can be trusted.
        matrix: (3, 3) float64 at the images' own size, or None.
        points0, points1: (M, 2) the sparse matches that agree with it, at the images' own size.
        matches: number of sparse matches it was estimated from.
        log10_nfa: decimal logarithm of its number of false alarms (`trust`).
        simulated: number of simulated views that it took.
    """

    kind: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    matches: int
    log10_nfa: float
    simulated: int


@dataclass(frozen=True, eq=False)
class InitialMatches:
    """Sparse matches of two images, before any geometry.

    Attributes:
        views: both images as uint8 luma, shrunk where they are large.
        scales: of the views, at most 1.
        features: SIFT features of the views.
        matched: (M, 2) positions in both views.
    """

    views: tuple[np.ndarray, np.ndarray]
    scales: tuple[float, float]
    features: tuple[Keypoints, Keypoints]
    matched: tuple[np.ndarray, np.ndarray]

    @property
    def points0(self) -> np.ndarray:
        """Matched positions in the first image at its own size, (M, 2) float64."""
        return scaled_points(self.matched[0], 1 / self.scales[0])

    @property
    def points1(self) -> np.ndarray:
        """Matched positions in the second image at its own size, (M, 2) float64."""
        return scaled_points(self.matched[1], 1 / self.scales[1])


def initial_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    features: tuple[Keypoints, Keypoints] | None = None,
) -> InitialMatches:
    """Match sparse SIFT features of two images, exactly, mutually and by the ratio test.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        features: of both images, shrunk where they are large, where they are there already; None:
            they are detected.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> found = initial_matches(image, image)
        >>> bool((found.points0 == found.points1).all()), len(found.points0) > 50
        (True, True)
    """
    (view0, scale0), (view1, scale1) = (downscale(gray, LONGEST) for gray in (gray0, gray1))
    if features is None:
        features = detect_sift(view0), detect_sift(view1)
    return InitialMatches((view0, view1), (scale0, scale1), features, _matched(*features))


def first_pass(
    gray0: np.ndarray,
    gray1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    initial: InitialMatches | None = None,
) -> FirstPass:
    """Estimate the geometry of a pair from few points.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        model: "homography", "fundamental", or "auto": the homography, but for scenes with depth
            (`select_model`).
        seed: of the random samples.
        initial: of `initial_matches`, where they are there already; None: they are made.

    Returns:
        The geometry, or the kind "none".

    Raises:
        OptionError: the model is unknown.
    """
    if model not in ("auto", *THRESHOLDS):
        raise unknown_name("model", model, ("auto", *THRESHOLDS))
    if initial is None:
        initial = initial_matches(gray0, gray1)
    view1 = initial.views[1]
    best = FirstPass("none", None, *np.empty((2, 0, 2)), 0, float("inf"), 0)
    simulated = 0
    for pairs, views in _looks(initial):
        simulated += views
        found = _estimate(*pairs, model, seed, (view1.shape[1], view1.shape[0]), simulated)
        if found.log10_nfa < best.log10_nfa:
            best = found
        if best.log10_nfa < MAX_LOG10_NFA:
            return _enlarged(best, *initial.scales)
    return FirstPass("none", None, *np.empty((2, 0, 2)), best.matches, best.log10_nfa, simulated)


def plain_first_pass(initial: InitialMatches, model: str = "auto", seed: int = 0) -> FirstPass:
    """Estimate the geometry of a pair from its initial matches alone, without simulated views.

    Args:
        initial: of `initial_matches`.
        model, seed: as of `first_pass`.

    Returns:
        The geometry, or the kind "none".
    """
    height, width = initial.views[1].shape
    found = _estimate(*initial.matched, model, seed, (width, height), 0)
    if found.log10_nfa < MAX_LOG10_NFA:
        return _enlarged(found, *initial.scales)
    return replace(
        found, kind="none", matrix=None, points0=np.empty((0, 2)), points1=np.empty((0, 2))
    )


def _looks(initial: InitialMatches) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], int]]:
    """Yield matched positions and the number of simulated views, from plain to strong tilts."""
    (view0, view1), (plain0, plain1) = initial.views, initial.features
    together = initial.matched
    yield together, 0
    for tilt in TILTS:
        views = 0
        for first, second, swapped in ((view0, plain1, False), (view1, plain0, True)):
            for seen in tilted_views(first, tilt, SiftOptions.max_keypoints // 2):
                pair = _matched(seen, second)
                together = tuple(
                    np.concatenate([had, new])
                    for had, new in zip(together, pair[::-1] if swapped else pair, strict=True)
                )
                views += 1
        together = _once(*together)
        yield together, views


def _matched(first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
    found = match_descriptors(
        first.descriptors, second.descriptors, get_matcher("exact"), ratio=RATIO, mutual=True
    )
    return _once(first.xy[found.rows0], second.xy[found.rows1])


def _once(points0: np.ndarray, points1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave each place once in each image: one corner in many views is no further evidence."""
    for side in (0, 1):
        places = np.rint((points0, points1)[side] / PLACE)
        _, kept = np.unique(places, axis=0, return_index=True)
        kept.sort()
        points0, points1 = points0[kept], points1[kept]
    return points0, points1


def _estimate(
    points0: np.ndarray,
    points1: np.ndarray,
    model: str,
    seed: int,
    size: tuple[int, int],
    simulated: int,
) -> FirstPass:
    """Estimate the models that are asked for and return the one that fits."""
    found: dict[str, FirstPass] = {}
    explained: dict[str, np.ndarray] = {}
    for kind in ("homography", "fundamental") if model == "auto" else (model,):
        options = GeometryOptions(model=kind, inlier_threshold=THRESHOLDS[kind], seed=seed)
        geometry = estimate_geometry(points0, points1, options)
        if geometry.matrix is None:
            continue
        errors_of = transfer_errors if kind == "homography" else epipolar_errors
        errors = errors_of(points0, points1, geometry.matrix)
        explained[kind] = geometry.inliers
        alarms = log10_nfa(errors, kind, THRESHOLDS[kind], size)
        found[kind] = FirstPass(
            kind,
            geometry.matrix,
            points0[geometry.inliers],
            points1[geometry.inliers],
            len(points0),
            alarms,
            simulated,
        )
    trusted = {kind: one for kind, one in found.items() if one.log10_nfa < MAX_LOG10_NFA}
    if len(trusted) == 2:
        return trusted[select_model(*explained.values())]
    nothing = FirstPass("none", None, *np.empty((2, 0, 2)), len(points0), float("inf"), simulated)
    return min((trusted or found).values(), key=lambda one: one.log10_nfa, default=nothing)


def _enlarged(found: FirstPass, scale0: float, scale1: float) -> FirstPass:
    """Return a geometry of shrunk images as one of the images themselves."""
    assert found.matrix is not None
    convert = scaled_homography if found.kind == "homography" else scaled_fundamental
    return replace(
        found,
        matrix=convert(found.matrix, 1 / scale0, 1 / scale1),
        points0=scaled_points(found.points0, 1 / scale0),
        points1=scaled_points(found.points1, 1 / scale1),
    )
