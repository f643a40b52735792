"""The first look at a pair: a geometry from few points, or the word that none can be trusted.

Plain SIFT first; simulated views (`views`) only when that gives nothing. No keypoint of DeepDetect
takes part, and nothing of the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry import GeometryOptions, estimate_geometry
from ..geometry.residuals import epipolar_errors, transfer_errors
from ..matchers import get_matcher, match_descriptors
from .sparse import MOST, SparseFeatures, sparse_features
from .trust import LARGEST, false_alarms
from .views import TILTS, tilted_views

LONGEST = 1200
"""Longer sides are shrunk to so many pixels: the first look need not be fine."""

RATIO = 0.85
THRESHOLDS = {"homography": 3.0, "fundamental": 1.5}
"""Pixels (of the shrunk images) within which matches agree with a model."""

DEPTH_OF_REST = 0.5
DEPTH_OF_ALL = 0.1
"""A scene has depth when the fundamental matrix explains at least half of the matches that the
homography leaves, and these are at least a tenth of all that it explains. (On planes it explains
some too, as a band is easily hit, but few of the rest.)"""


@dataclass(frozen=True, eq=False)
class FirstPass:
    """A geometry from few points.

    Attributes:
        kind: "homography", "fundamental", or "none" when no geometry can be trusted.
        matrix: (3, 3) float64 at the images' own size, or None.
        points0, points1: (M, 2) the sparse matches that agree with it, at the images' own size.
        matches: number of sparse matches it was estimated from.
        log_false_alarms: decimal logarithm of its number of false alarms (`trust`).
        simulated: number of simulated views that it took.
    """

    kind: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    matches: int
    log_false_alarms: float
    simulated: int


def first_pass(
    gray0: np.ndarray, gray1: np.ndarray, model: str = "auto", seed: int = 0
) -> FirstPass:
    """Estimate the geometry of a pair from few points.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        model: "homography", "fundamental", or "auto": the homography, but for scenes with depth
            (`has_depth`).
        seed: of the random samples.

    Returns:
        The geometry, or the kind "none".
    """
    small = [_shrunk(gray) for gray in (gray0, gray1)]
    (view0, scale0), (view1, scale1) = small
    best = FirstPass("none", None, *np.empty((2, 0, 2)), 0, float("inf"), 0)
    simulated = 0
    for pairs, views in _looks(view0, view1):
        simulated += views
        found = _estimate(*pairs, model, seed, (view1.shape[1], view1.shape[0]), simulated)
        if found.log_false_alarms < best.log_false_alarms:
            best = found
        if best.log_false_alarms < LARGEST:
            return _enlarged(best, scale0, scale1)
    return FirstPass(
        "none", None, *np.empty((2, 0, 2)), best.matches, best.log_false_alarms, simulated
    )


def _looks(
    view0: np.ndarray, view1: np.ndarray
) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], int]]:
    """Yield matched positions and the number of simulated views, from plain to strong tilts."""
    plain0, plain1 = sparse_features(view0), sparse_features(view1)
    together = _matched(plain0, plain1)
    yield together, 0
    for tilt in TILTS:
        views = 0
        for first, second, swapped in ((view0, plain1, False), (view1, plain0, True)):
            for seen in tilted_views(first, tilt, MOST // 2):
                pair = _matched(seen, second)
                together = tuple(
                    np.concatenate([had, new])
                    for had, new in zip(together, pair[::-1] if swapped else pair, strict=True)
                )
                views += 1
        together = _once(*together)
        yield together, views


def _matched(first: SparseFeatures, second: SparseFeatures) -> tuple[np.ndarray, np.ndarray]:
    found = match_descriptors(
        first.descriptors, second.descriptors, get_matcher("exact"), ratio=RATIO, mutual=True
    )
    return _once(first.xy[found.rows0], second.xy[found.rows1])


def _once(points0: np.ndarray, points1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave each match once: the same corner seen in several views is no further evidence."""
    both = np.rint(np.column_stack([points0, points1]) / 2)
    _, kept = np.unique(both, axis=0, return_index=True)
    kept.sort()
    return points0[kept], points1[kept]


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
        alarms = false_alarms(errors, kind, THRESHOLDS[kind], size)
        found[kind] = FirstPass(
            kind,
            geometry.matrix,
            points0[geometry.inliers],
            points1[geometry.inliers],
            len(points0),
            alarms,
            simulated,
        )
    trusted = {kind: one for kind, one in found.items() if one.log_false_alarms < LARGEST}
    if len(trusted) == 2:
        return trusted["fundamental" if has_depth(*explained.values()) else "homography"]
    nothing = FirstPass("none", None, *np.empty((2, 0, 2)), len(points0), float("inf"), simulated)
    return min((trusted or found).values(), key=lambda one: one.log_false_alarms, default=nothing)


def has_depth(by_homography: np.ndarray, by_fundamental: np.ndarray) -> bool:
    """Tell whether a scene is more than a plane, from which matches the two models explain.

    Args:
        by_homography, by_fundamental: (M,) bool.

    Example:
        >>> plane = np.arange(100) < 60
        >>> has_depth(plane, plane), has_depth(plane, np.arange(100) < 95)
        (False, True)
    """
    rest = by_fundamental & ~by_homography
    left, all_of_it = np.count_nonzero(~by_homography), np.count_nonzero(by_fundamental)
    return bool(rest.sum() >= max(DEPTH_OF_REST * left, DEPTH_OF_ALL * all_of_it, 1))


def _shrunk(gray: np.ndarray) -> tuple[np.ndarray, float]:
    scale = min(1.0, LONGEST / max(gray.shape))
    if scale == 1:
        return gray, 1.0
    size = (max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale)))
    return cv2.resize(gray, size, interpolation=cv2.INTER_AREA), scale


def _enlarged(found: FirstPass, scale0: float, scale1: float) -> FirstPass:
    """Return a geometry of shrunk images as one of the images themselves."""
    to_small, back = (_scaling(scale0), np.linalg.inv(_scaling(scale1)))
    assert found.matrix is not None
    if found.kind == "homography":
        matrix = back @ found.matrix @ to_small
        matrix /= matrix[2, 2]
    else:
        matrix = _scaling(scale1).T @ found.matrix @ to_small
    points = [
        (points + 0.5) / scale - 0.5
        for points, scale in ((found.points0, scale0), (found.points1, scale1))
    ]
    return FirstPass(
        found.kind, matrix, *points, found.matches, found.log_false_alarms, found.simulated
    )


def _scaling(scale: float) -> np.ndarray:
    """Return the (3, 3) map of an image to a shrunk one; pixel centres are whole numbers."""
    shift = 0.5 * scale - 0.5
    return np.array([[scale, 0, shift], [0, scale, shift], [0, 0, 1]])
