"""The initial geometry of a pair, from sparse matches, or that none can be trusted.

A look at small copies first, which is enough where the pair is clearly a plane; then plain SIFT on
larger ones; simulated views (`asift`) only when that gives nothing. No DeepDetect keypoint takes
part, but points of all scales, where the caller has matched them (`sparse_matches`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..._shared.errors import OptionError, unknown_name
from ...features.matches import TwoViewGeometry
from ...geometry import GeometryOptions, estimate_geometry
from ...geometry.acontrario import log10_nfa
from ...geometry.model_selection import Parallax, measure_parallax
from ...geometry.rescaling import scaled_fundamental, scaled_homography, scaled_points
from ...geometry.residuals import epipolar_errors, transfer_errors
from ...geometry.semi_calibrated import (
    SemiCalibratedOptions,
    estimate_semi_calibrated,
    refine_fundamental,
)
from .along_lines import log10_chance, match_along_lines
from .asift import simulated_views
from .options import InitialGeometryOptions
from .sparse_matches import Points, TentativeMatches, match_features, separate, tentative_matches

MODELS = ("homography", "fundamental")

Size = tuple[int, int]


@dataclass(frozen=True, eq=False)
class InitialGeometry:
    """A geometry from sparse matches.

    Attributes:
        model: "homography", "fundamental", or "none" when no geometry can be trusted.
        matrix: (3, 3) float64 at the images' own size, or None.
        points0, points1: (M, 2) the sparse matches that agree with it, at the images' own size.
        num_matches: sparse matches that it was estimated from.
        log10_nfa: decimal logarithm of its number of false alarms.
        num_views: simulated views that it took.
        parallax: of a homography that was chosen, not asked for: what it leaves.
        initial: the sparse matches of the larger images, where they have been made.
    """

    model: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    num_matches: int
    log10_nfa: float
    num_views: int
    parallax: Parallax | None = None
    initial: TentativeMatches | None = None

    def as_two_view_geometry(self) -> TwoViewGeometry:
        """Return what the user is told of it."""
        return TwoViewGeometry(
            self.model,
            self.matrix,
            self.num_matches,
            len(self.points0),
            float(self.log10_nfa),
            self.num_views,
        )


def find_initial_geometry(
    gray0: np.ndarray,
    gray1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    options: InitialGeometryOptions = InitialGeometryOptions(),
    initial: TentativeMatches | None = None,
) -> InitialGeometry:
    """Find the geometry of a pair, by the least effort that it takes.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        model: as of `estimate_initial_geometry`.
        seed: of the random samples.
        options: sizes, thresholds, and which views are simulated.
        initial: sparse matches, where `tentative_matches` has made them already.

    Returns:
        The geometry, or one with the model "none".

    Raises:
        OptionError: the model is unknown.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> find_initial_geometry(image, image).model
        'homography'
    """
    longest = max(*gray0.shape, *gray1.shape)
    first_side = min(options.first_side_px, options.max_side_px)
    if initial is None and longest > first_side and model != "fundamental":
        small = _scaled_down(options, first_side, options.first_max_keypoints)
        look = tentative_matches(gray0, gray1, options=small)
        found = estimate_initial_geometry(look, model, seed, small, simulate_views=False)
        if _is_clearly_a_plane(found, options) or _is_clearly_depth(found, options):
            return found
    if initial is None:
        initial = tentative_matches(gray0, gray1, options=options)
    found = estimate_initial_geometry(initial, model, seed, options, simulate_views=False)
    if found.matrix is not None:
        return replace(found, initial=initial)
    simulated_side = min(options.simulated_side_px, options.max_side_px)
    if longest > simulated_side:
        options = _scaled_down(options, simulated_side, options.simulated_max_keypoints)
        initial = tentative_matches(gray0, gray1, options=options)
    return estimate_initial_geometry(initial, model, seed, options)


def geometry_of_points(
    tentative: Points,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    model: str = "auto",
    seed: int = 0,
    options: InitialGeometryOptions = InitialGeometryOptions(),
) -> InitialGeometry:
    """Estimate the geometry of a pair from tentative matches that were found elsewhere.

    Args:
        tentative: (K, 2) positions in both images, some of them wrong.
        sizes: (width, height) of both images.
        model: as of `estimate_initial_geometry`.
        seed: of the random samples.
        options: thresholds; they hold for images of at most `max_side_px`.

    Returns:
        The geometry, or one with the model "none".

    Raises:
        OptionError: the model is unknown, or the matches are not two (K, 2) arrays of finite
            numbers.

    Example:
        >>> points = np.random.default_rng(0).uniform(0, 99, (30, 2))
        >>> found = geometry_of_points((points, points + 3), ((110, 110), (110, 110)))
        >>> found.matrix[:2, 2].round(3)
        array([3., 3.])
    """
    if model not in ("auto", *MODELS):
        raise unknown_name("model", model, ("auto", *MODELS))
    try:
        points0, points1 = (np.array(points, np.float64) for points in tentative)
    except (TypeError, ValueError):
        points0 = points1 = np.empty(0)
    if points0.ndim != 2 or points0.shape[1:] != (2,) or points0.shape != points1.shape:
        raise OptionError(
            "tentative matches must be two arrays of shape (K, 2): positions in both images"
        )
    if not (np.isfinite(points0).all() and np.isfinite(points1).all()):
        raise OptionError(
            "tentative matches must be finite positions: leave out those that are not"
        )
    scales = [min(1.0, options.max_side_px / max(size)) for size in sizes]
    width, height = (
        [round(size[axis] * scale) for size, scale in zip(sizes, scales, strict=True)]
        for axis in (0, 1)
    )
    views = (width[0], height[0]), (width[1], height[1])
    scaled = (scaled_points(points0, scales[0]), scaled_points(points1, scales[1]))
    points = separate(*scaled, min_separation_px=options.min_separation_px)
    found = _estimate((points[0], points[1]), model, seed, views, options)
    if found.log10_nfa < options.max_log10_nfa:
        return _upscale(found, scales[0], scales[1])
    return replace(_nothing(found.num_matches), log10_nfa=found.log10_nfa)


def estimate_initial_geometry(
    initial: TentativeMatches,
    model: str = "auto",
    seed: int = 0,
    options: InitialGeometryOptions = InitialGeometryOptions(),
    simulate_views: bool = True,
) -> InitialGeometry:
    """Estimate the geometry of a pair from its sparse matches, and those of simulated views.

    Args:
        initial: the sparse matches.
        model: "homography", "fundamental", or "auto": the homography, but the fundamental matrix
            where the matches alone show depth (`measure_parallax`).
        seed: of the random samples.
        options: thresholds, and which views are simulated.
        simulate_views: whether views are simulated where the sparse matches alone give nothing.

    Returns:
        The geometry, or one with the model "none".

    Raises:
        OptionError: the model is unknown.
    """
    if model not in ("auto", *MODELS):
        raise unknown_name("model", model, ("auto", *MODELS))
    best = _nothing(0)
    num_views = 0
    for points, ratios, views in _more_and_more_matches(initial, options):
        num_views += views
        height, width = zip(*(view.shape for view in initial.views), strict=True)
        sizes = (width[0], height[0]), (width[1], height[1])
        for ratio in options.max_ratios:
            chosen = points[0][ratios < ratio], points[1][ratios < ratio]
            found = _estimate(chosen, model, seed, sizes, options)
            found = _with_further_evidence(found, chosen[0], initial, options)
            if found.log10_nfa < best.log10_nfa:
                best = replace(found, num_views=num_views)
            if best.log10_nfa < options.max_log10_nfa:
                best = _with_further_matches(best, initial, sizes, options)
                return _upscale(best, *initial.scales)
        if not simulate_views or (num_views and best.log10_nfa > options.max_hint_log10_nfa):
            break
    return replace(_nothing(best.num_matches), log10_nfa=best.log10_nfa, num_views=num_views)


def _scaled_down(
    options: InitialGeometryOptions, max_side_px: int, max_keypoints: int
) -> InitialGeometryOptions:
    """Return the options of a quick look at small images, with few keypoints."""
    sift = replace(options.sift, max_keypoints=min(max_keypoints, options.sift.max_keypoints))
    return replace(options, max_side_px=max_side_px, sift=sift, semi_calibrated=None)


def _is_clearly_a_plane(found: InitialGeometry, options: InitialGeometryOptions) -> bool:
    """Whether most matches agree with a homography, and not many others on an epipole."""
    needed = max(options.min_first_inliers, options.min_first_fraction * found.num_matches)
    if found.model != "homography" or len(found.points0) < needed:
        return False
    parallax = found.parallax
    if parallax is None or not parallax.is_seen(options.model_selection):
        return True
    return parallax.agreeing <= options.max_first_parallax * parallax.on_plane


def _is_clearly_depth(found: InitialGeometry, options: InitialGeometryOptions) -> bool:
    """Whether most matches, and many, agree with a fundamental matrix."""
    needed = max(options.min_first_depth_inliers, options.min_first_fraction * found.num_matches)
    return found.model == "fundamental" and len(found.points0) >= needed


def _nothing(num_matches: int) -> InitialGeometry:
    nowhere = np.empty((0, 2))
    return InitialGeometry("none", None, nowhere, nowhere, num_matches, float("inf"), 0)


def _more_and_more_matches(
    initial: TentativeMatches, options: InitialGeometryOptions
) -> Iterator[tuple[Points, np.ndarray, int]]:
    """Yield matched positions, ratios and the number of simulated views, up to strong tilts."""
    (points0, points1), ratios = initial.matched, initial.ratios
    yield (points0, points1), ratios, 0
    of_view = replace(options.sift, max_keypoints=options.sift.max_keypoints // 2)
    for tilt in options.tilts:
        views = 0
        for side in (0, 1):
            other = initial.features[1 - side]
            gray = initial.views[side]
            for seen in simulated_views(gray, tilt, options.rotation_step_deg, of_view):
                found = match_features(seen, other, options)
                points0 = np.concatenate([points0, found[side]])
                points1 = np.concatenate([points1, found[1 - side]])
                ratios = np.concatenate([ratios, found[2]])
                views += 1
        points0, points1, ratios = separate(
            points0, points1, ratios, min_separation_px=options.min_separation_px
        )
        yield (points0, points1), ratios, views


def _estimate(
    points: Points, model: str, seed: int, sizes: tuple[Size, Size], options: InitialGeometryOptions
) -> InitialGeometry:
    """Estimate the models that are asked for and return the one that fits."""
    plane = depth = _nothing(len(points[0]))
    if model != "fundamental":
        plane = _fit(points, "homography", seed, sizes[1], options)
    if plane.log10_nfa < options.max_log10_nfa:
        assert plane.matrix is not None
        if model == "homography":
            return plane
        parallax = measure_parallax(*points, plane.matrix, options.model_selection, seed)
        plane = replace(plane, parallax=parallax)
        if not parallax.is_depth(options.model_selection):
            return plane
    if model != "homography":
        depth = _fit(points, "fundamental", seed, sizes[1], options)
        known = _fit_semi_calibrated(points, seed, sizes, options)
        depth = min(depth, known, key=lambda one: one.log10_nfa)
        if depth.log10_nfa < options.max_log10_nfa:
            return depth
    return min(plane, depth, key=lambda one: one.log10_nfa)


def _fit(
    points: Points, model: str, seed: int, size: Size, options: InitialGeometryOptions
) -> InitialGeometry:
    """Estimate one model, trusted or not."""
    threshold = options.threshold_px(model)
    chosen = GeometryOptions(inlier_threshold=threshold)
    geometry = estimate_geometry(*points, model, seed=seed, options=chosen)
    if geometry.matrix is None:
        return _nothing(len(points[0]))
    errors_of = transfer_errors if model == "homography" else epipolar_errors
    alarms = log10_nfa(errors_of(*points, geometry.matrix), model, threshold, size)
    return _found(model, geometry.matrix, points, geometry.inliers, alarms)


def _fit_semi_calibrated(
    points: Points, seed: int, sizes: tuple[Size, Size], options: InitialGeometryOptions
) -> InitialGeometry:
    """Estimate a fundamental matrix with what is known of most cameras, trusted or not."""
    if options.semi_calibrated is None:
        return _nothing(len(points[0]))
    threshold = options.fundamental_threshold_px
    found = estimate_semi_calibrated(*points, sizes, threshold, seed, options.semi_calibrated)
    if found is None:
        return _nothing(len(points[0]))
    return _found("fundamental", found.matrix, points, found.inliers, found.log10_nfa)


def _found(
    model: str, matrix: np.ndarray, points: Points, inliers: np.ndarray, alarms: float
) -> InitialGeometry:
    points0, points1 = points[0][inliers], points[1][inliers]
    return InitialGeometry(model, matrix, points0, points1, len(inliers), alarms, 0)


def _with_further_evidence(
    found: InitialGeometry,
    used: np.ndarray,
    initial: TentativeMatches,
    options: InitialGeometryOptions,
) -> InitialGeometry:
    """Let keypoints that no match was made of decide where a fundamental matrix is in doubt."""
    doubtful = options.max_log10_nfa <= found.log10_nfa < options.max_hint_log10_nfa
    if found.model != "fundamental" or not doubtful:
        return found
    assert found.matrix is not None
    chance = log10_chance(*initial.features, found.matrix, used, options.line_search)
    return replace(found, log10_nfa=found.log10_nfa + chance)


def _with_further_matches(
    found: InitialGeometry,
    initial: TentativeMatches,
    sizes: tuple[Size, Size],
    options: InitialGeometryOptions,
) -> InitialGeometry:
    """Search along the lines of a fundamental matrix that few matches agree with, and refit it."""
    if found.model != "fundamental" or len(found.points0) >= options.max_matches_to_search:
        return found
    assert found.matrix is not None
    further = match_along_lines(*initial.features, found.matrix, options.line_search)
    points0, points1 = separate(
        np.concatenate([found.points0, further[0]]),
        np.concatenate([found.points1, further[1]]),
        min_separation_px=options.min_separation_px,
    )
    known = options.semi_calibrated or SemiCalibratedOptions()
    sigmas = np.full(len(points0), known.match_sigma_px)
    matrix = refine_fundamental(points0, points1, found.matrix, sizes, sigmas, known)
    inliers = epipolar_errors(points0, points1, matrix) < options.fundamental_threshold_px
    if np.count_nonzero(inliers) <= len(found.points0):
        return found
    return replace(found, matrix=matrix, points0=points0[inliers], points1=points1[inliers])


def _upscale(found: InitialGeometry, scale0: float, scale1: float) -> InitialGeometry:
    """Return a geometry of scaled images as one of the images themselves."""
    assert found.matrix is not None
    convert = scaled_homography if found.model == "homography" else scaled_fundamental
    return replace(
        found,
        matrix=convert(found.matrix, 1 / scale0, 1 / scale1),
        points0=scaled_points(found.points0, 1 / scale0),
        points1=scaled_points(found.points1, 1 / scale1),
    )
