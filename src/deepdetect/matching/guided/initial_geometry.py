"""The initial geometry of a pair from tentative matches, or the answer that none can be trusted.

A coarse pass matches SIFT keypoints of small copies. Its result is used if it clearly shows a plane
or depth. Otherwise SIFT keypoints of larger copies are matched. If they give no geometry, or if the
images come from two sensors, learned descriptors replace SIFT. Simulated views (`asift`) are the
last resort. `geometry.two_view` chooses the model. Its thresholds, and those below without another
source, were chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ..._shared.errors import ImageError
from ...detector.points.descriptor import describe_learned
from ...features.keypoints import Keypoints
from ...features.learned import CROSS_MODAL
from ...features.matches import Evidence, TwoViewGeometry
from ...geometry.estimation import TwoViewModel
from ...geometry.images import downscale, zncc_at_points
from ...geometry.lens import UNDISTORT, distortion
from ...geometry.semi_calibrated import MATCH_SIGMA_PX, refine_fundamental
from ...geometry.transforms import (
    epipolar_errors,
    scaled_fundamental,
    scaled_homography,
    scaled_points,
)
from ...geometry.two_view import GUIDING_THRESHOLDS_PX, choose_model
from .asift import learned_points, simulated_views
from .epipolar_search import epipolar_search, log10_p_value
from .tentative_matches import (
    MAX_RATIOS,
    MAX_SIDE_PX,
    Pair,
    TentativeMatches,
    find_tentative_matches,
    match_sparse,
    matches_of_points,
    separate,
)

LEARNED_KEYPOINTS = 2048
"""Maximum number of keypoints with learned descriptors. Chosen by hand."""

COARSE_SIDE_PX, COARSE_KEYPOINTS = 640, 2000
"""Longer side in pixels and maximum keypoints in the coarse pass. Chosen on Oxford and others."""

MIN_COARSE_INLIERS = 50
"""The coarse pass is used if a homography has at least this many inliers, the caller's keypoints if
any model has. If SIFT on larger copies gives fewer inliers, learned descriptors are tried."""

MIN_COARSE_DEPTH_INLIERS = 200
"""Inliers that a fundamental matrix of the coarse pass needs. Chosen on Oxford and others."""

MIN_COARSE_FRACTION = 0.5
"""Minimum fraction of inliers in the coarse pass. Chosen on Oxford and others."""

SIMULATED_SIDE_PX, SIMULATED_KEYPOINTS = 320, 1000
"""Longer side in pixels, and maximum number of keypoints, of the images from which oblique views
are simulated. Each view has half as many keypoints. Chosen by hand."""

WINDOW_PX = 16
"""Side in pixels of the windows that are checked for inverted brightness. Chosen by hand."""

MIN_GAIN = 1.2
"""Images are from two sensors if cross-modal descriptors give at least this many times the matches
of learned descriptors: 1.5 to 30 for visible and infrared light, up to 1.17 for photographs."""

MIN_INVERTED = 0.05
"""Images are also from two sensors if at least this fraction of the inliers is dark in one image
and bright in the other. Wrong matches give up to 0.04 for wide-baseline pairs of KITTI."""

MAX_LEARNED_LOG10_NFA, MAX_CROSS_MODAL_LOG10_NFA = -10.0, -22.0
"""Maximum log10 number of false alarms of a geometry from learned and from cross-modal descriptors.
The values are low because networks also see image borders, which match in unrelated images.
Unrelated photographs reach -8 with learned descriptors. With cross-modal ones, noise of 320x240
pixels reaches -20, and visible and infrared light have -24 or less."""

MAX_MATCHES_TO_SEARCH = 200
"""If a fundamental matrix has fewer inliers, more are searched along its epipolar lines."""

MAX_HINT_LOG10_NFA = 0.0
"""If an untrusted geometry has a log10 number of false alarms below this, it may be more than
chance: larger copies are tried, and further matches along its epipolar lines are counted."""


Source = TentativeMatches | Pair | tuple[Keypoints, Keypoints] | None
"""What a geometry is estimated from: tentative matches; matches of another matcher, as (K, 2)
positions in each image; or keypoints of both images. Keypoints are used if each image has at least
`MIN_POINTS` of them, with sizes and angles. Otherwise, and for None, SIFT keypoints are used."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InitialGeometry(TwoViewModel):
    """A geometry of tentative matches, in pixels of the full-size images.

    The model is "none" if no geometry can be trusted. `points0` and `points1` are the inliers;
    `others` are the outliers. The model is `prescribed` if the caller did not ask for "auto".
    `num_views` is the number of simulated views. From the `source`, another model can be estimated.
    The geometry is `learned` if it comes from learned descriptors, and `cross_modal` if it comes
    from images of two sensors.
    """

    points0: np.ndarray
    points1: np.ndarray
    others: Pair
    prescribed: bool = False
    num_views: int = 0
    source: Source = None
    learned: bool = False
    cross_modal: bool = False

    @classmethod
    def of(
        cls, model: TwoViewModel, points0: np.ndarray, points1: np.ndarray, asked: str
    ) -> InitialGeometry:
        """Split matches into inliers and outliers of a model; `asked` is the caller's `model`."""
        agreeing, rest = model.inliers, ~model.inliers
        return cls(
            **vars(model),
            points0=points0[agreeing],
            points1=points1[agreeing],
            others=(points0[rest], points1[rest]),
            prescribed=asked != "auto",
        )

    @property
    def all_points(self) -> Pair:
        """Positions of all matches in both images, inliers first."""
        points0, points1 = self.others
        return np.concatenate([self.points0, points0]), np.concatenate([self.points1, points1])

    def untrusted(self) -> InitialGeometry:
        """Return this geometry as the model "none", without its matrix and its inliers."""
        nowhere = np.empty((0, 2))
        return replace(self, model="none", matrix=None, points0=nowhere, points1=nowhere)

    def only_below(self, max_log10_nfa: float) -> InitialGeometry:
        """Return this geometry if its `log10_nfa` is below a limit, otherwise as `untrusted`."""
        return self if self.log10_nfa < max_log10_nfa else self.untrusted()

    def rescaled(self, scale0: float, scale1: float) -> InitialGeometry:
        """Convert the geometry of images scaled by these factors to the images at full size."""
        assert self.matrix is not None
        convert = scaled_homography if self.model == "homography" else scaled_fundamental
        return replace(
            self,
            matrix=convert(self.matrix, 1 / scale0, 1 / scale1),
            points0=scaled_points(self.points0, 1 / scale0),
            points1=scaled_points(self.points1, 1 / scale1),
            others=(
                scaled_points(self.others[0], 1 / scale0),
                scaled_points(self.others[1], 1 / scale1),
            ),
        )

    def require_straight_lines(self, grays: Pair) -> None:
        """Raise an ImageError if a lens that bends lines fits the matches better than a pinhole."""
        points0, points1 = self.all_points
        agreeing = np.arange(len(points0)) < len(self.points0)
        sizes = grays[0].shape[::-1], grays[1].shape[::-1]
        if distortion(points0, points1, agreeing, sizes):
            raise ImageError(
                "the lens of both images bends straight lines, as that of a fisheye, which no "
                f"pinhole geometry fits: {UNDISTORT}"
            )

    def as_two_view_geometry(self) -> TwoViewGeometry:
        """Return the geometry as the public type `TwoViewGeometry`."""
        counts = len(self.inliers), len(self.points0)
        evidence = Evidence(*counts, float(self.log10_nfa), self.num_views)
        return TwoViewGeometry(self.model, self.matrix, evidence=evidence)


def guiding_geometry(
    grays: Pair, model: str = "auto", seed: int = 0, source: Source = None
) -> InitialGeometry:
    """Find the geometry that guides the matching, trying the cheapest way first."""
    if isinstance(source, TentativeMatches):
        geometry = replace(estimate_initial_geometry(source, model, seed), source=source)
    elif isinstance(source, tuple) and not isinstance(source[0], Keypoints):
        return replace(_geometry_of_positions(grays, source, model, seed), source=source)
    else:
        matches = None if source is None else matches_of_points(grays, source)
        if matches is not None:
            geometry = estimate_initial_geometry(matches, model, seed)
            if len(geometry.points0) >= MIN_COARSE_INLIERS:
                return replace(geometry, source=source)
        geometry = _geometry_of_keypoints(grays, model, seed, source)
    if geometry.matrix is not None:
        return geometry
    tentative = _learned_matches(grays, SIMULATED_SIDE_PX, SIMULATED_KEYPOINTS)
    geometry = estimate_initial_geometry(
        tentative, model, seed, semi_calibrated=False, view_keypoints=SIMULATED_KEYPOINTS // 2
    )
    return replace(geometry.only_below(MAX_LEARNED_LOG10_NFA), source=source)


def _geometry_of_keypoints(
    grays: Pair, model: str, seed: int, source: tuple[Keypoints, Keypoints] | None
) -> InitialGeometry:
    """Find the geometry from SIFT's keypoints, or from points with learned descriptors."""
    longest, learned = max(max(gray.shape) for gray in grays), None
    if longest > COARSE_SIDE_PX and model != "fundamental":
        coarse = find_tentative_matches(
            *grays, max_side_px=COARSE_SIDE_PX, max_keypoints=COARSE_KEYPOINTS
        )
        geometry = estimate_initial_geometry(coarse, model, seed, semi_calibrated=False)
        if _is_clear(geometry):
            return replace(geometry, source=source)
        if geometry.log10_nfa >= MAX_HINT_LOG10_NFA:
            learned = _learned_geometry(grays, model, seed)
            if learned.log10_nfa >= MAX_HINT_LOG10_NFA:
                # If small copies show not even a hint, larger ones show nothing either.
                return learned
    tentative = find_tentative_matches(*grays)
    geometry = estimate_initial_geometry(tentative, model, seed)
    if len(geometry.points0) < MIN_COARSE_INLIERS:
        learned = learned or _learned_geometry(grays, model, seed)
        more = len(learned.points0) > len(geometry.points0)
        if geometry.matrix is None or (learned.cross_modal and more):
            return learned
    return replace(geometry, source=tentative)


def _learned_geometry(grays: Pair, model: str, seed: int) -> InitialGeometry:
    """Find the geometry from keypoints with learned descriptors, or cross-modal ones if needed.

    In different light, in the dark, under blur or from another side, these keypoints have two to
    fifteen times the inliers of SIFT. SIFT's positions are more exact, which helps to tell depth
    from a plane.
    """
    as_it_is = _learned_matches(grays, COARSE_SIDE_PX, LEARNED_KEYPOINTS)
    seen = as_it_is.views, as_it_is.features
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(describe_learned, *seen, 2 * (CROSS_MODAL,))
    across = find_tentative_matches(*grays, (first, second), max_side_px=COARSE_SIDE_PX)
    geometry, other = (estimate_initial_geometry(each, model, seed) for each in (as_it_is, across))
    better = other.log10_nfa < min(geometry.log10_nfa, MAX_CROSS_MODAL_LOG10_NFA)
    gain = len(across.ratios) >= MIN_GAIN * len(as_it_is.ratios)
    if better and (gain or _is_inverted(across, other)):
        return replace(other, source=across, learned=True, cross_modal=True)
    return replace(geometry.only_below(MAX_LEARNED_LOG10_NFA), source=as_it_is, learned=True)


def _is_inverted(tentative: TentativeMatches, geometry: InitialGeometry) -> bool:
    """Return whether enough inliers (`MIN_INVERTED`) are dark in one image, bright in the other."""
    scale0, scale1 = tentative.scales
    agreeing = scaled_points(geometry.points0, scale0), scaled_points(geometry.points1, scale1)
    correlations = zncc_at_points(tentative.views, agreeing, WINDOW_PX)
    return bool(np.mean(correlations < 0) >= MIN_INVERTED)


def _learned_matches(grays: Pair, side_px: int, keypoints: int) -> TentativeMatches:
    views = downscale(grays[0], side_px)[0], downscale(grays[1], side_px)[0]
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(learned_points, views, (keypoints, keypoints))
    return find_tentative_matches(*grays, (first, second), max_side_px=side_px)


def _is_clear(geometry: InitialGeometry) -> bool:
    """Return whether enough matches of the coarse pass agree with its model to use it."""
    depth = geometry.model == "fundamental"
    least = MIN_COARSE_DEPTH_INLIERS if depth else MIN_COARSE_INLIERS
    most = len(geometry.points0) >= max(least, MIN_COARSE_FRACTION * len(geometry.inliers))
    return geometry.matrix is not None and most


def _geometry_of_positions(grays: Pair, points: Pair, model: str, seed: int) -> InitialGeometry:
    """Estimate the geometry from sparse matches of another matcher, some of them wrong."""
    # Thresholds are in pixels of images with this longer side, so larger positions are scaled down.
    scale0, scale1 = (min(1.0, MAX_SIDE_PX / max(gray.shape)) for gray in grays)
    size0, size1 = (
        (round(gray.shape[1] * scale), round(gray.shape[0] * scale))
        for gray, scale in zip(grays, (scale0, scale1), strict=True)
    )
    scaled0, scaled1 = separate(scaled_points(points[0], scale0), scaled_points(points[1], scale1))
    chosen = choose_model(scaled0, scaled1, (size0, size1), model, seed)
    geometry = InitialGeometry.of(chosen, scaled0, scaled1, model)
    return geometry.rescaled(scale0, scale1) if geometry.trusted else geometry.untrusted()


def estimate_initial_geometry(
    tentative: TentativeMatches,
    model: str = "auto",
    seed: int = 0,
    *,
    semi_calibrated: bool = True,
    view_keypoints: int = 0,
) -> InitialGeometry:
    """Estimate the geometry of a pair from tentative matches and those of simulated views.

    Each simulated view has `view_keypoints` keypoints; if this is 0, no views are simulated. For
    the other arguments see `choose_model`.
    """
    sizes = tentative.views[0].shape[::-1], tentative.views[1].shape[::-1]
    nowhere = np.empty((0, 2))
    nothing = TwoViewModel("none", None, np.zeros(0, bool), float("inf"))
    best = InitialGeometry.of(nothing, nowhere, nowhere, model)
    points, ratios, views = tentative.matched, tentative.ratios, 0
    if view_keypoints:
        points, ratios, views = _matches_of_views(tentative, view_keypoints)
    for ratio in MAX_RATIOS:
        chosen = points[0][ratios < ratio], points[1][ratios < ratio]
        two_view = choose_model(*chosen, sizes, model, seed, semi_calibrated)
        geometry = InitialGeometry.of(two_view, *chosen, model)
        geometry = _with_further_evidence(geometry, chosen[0], tentative)
        if geometry.log10_nfa < best.log10_nfa:
            best = geometry
        if best.trusted:
            break
    best = replace(best, num_views=views)
    if not best.trusted:
        return best.untrusted()
    return _with_further_matches(best, tentative).rescaled(*tentative.scales)


def _matches_of_views(
    tentative: TentativeMatches, view_keypoints: int
) -> tuple[Pair, np.ndarray, int]:
    """Add the matches of simulated views; return positions, ratios and the number of views."""
    found = [(*tentative.matched, tentative.ratios)]
    for side, seen in simulated_views(tentative.views, view_keypoints):
        further = match_sparse(seen, tentative.features[1 - side])
        found.append((further[side], further[1 - side], further[2]))
    points0, points1, ratios = separate(*map(np.concatenate, zip(*found, strict=True)))
    return (points0, points1), ratios, len(found) - 1


def _with_further_evidence(
    geometry: InitialGeometry, used: np.ndarray, tentative: TentativeMatches
) -> InitialGeometry:
    """If a fundamental matrix is in doubt, let keypoints that are not yet matched decide."""
    doubtful = not geometry.trusted and geometry.log10_nfa < MAX_HINT_LOG10_NFA
    if geometry.model != "fundamental" or not doubtful:
        return geometry
    assert geometry.matrix is not None
    chance = log10_p_value(*tentative.features, geometry.matrix, used)
    return replace(geometry, log10_nfa=geometry.log10_nfa + chance)


def _with_further_matches(
    geometry: InitialGeometry, tentative: TentativeMatches
) -> InitialGeometry:
    """If a fundamental matrix has few inliers, search for more along its lines, and refit it."""
    if geometry.model != "fundamental" or len(geometry.points0) >= MAX_MATCHES_TO_SEARCH:
        return geometry
    assert geometry.matrix is not None
    further = epipolar_search(*tentative.features, geometry.matrix)
    points0, points1 = separate(
        np.concatenate([geometry.points0, further[0]]),
        np.concatenate([geometry.points1, further[1]]),
    )
    sizes = tentative.views[0].shape[::-1], tentative.views[1].shape[::-1]
    sigmas = np.full(len(points0), MATCH_SIGMA_PX)
    matrix = refine_fundamental(points0, points1, geometry.matrix, sizes, sigmas)
    inliers = epipolar_errors(points0, points1, matrix) < GUIDING_THRESHOLDS_PX["fundamental"]
    if np.count_nonzero(inliers) <= len(geometry.points0):
        return geometry
    return replace(geometry, matrix=matrix, points0=points0[inliers], points1=points1[inliers])
