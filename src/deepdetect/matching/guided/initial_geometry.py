"""The initial geometry of a pair from tentative matches, or the answer that none can be trusted.

A coarse pass on small copies comes first. It suffices if the pair is clearly a plane or clearly has
depth. SIFT on larger copies follows. If it finds nothing, or little between images of different
sensors, learned descriptors and simulated views (`asift`) are used. `geometry.two_view` chooses the
model. Its thresholds, and those here if nothing else is said, were chosen on all of Oxford and
Middlebury, Strecha's fountain and a KITTI clip.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from ...detector.points.descriptor import describe_learned
from ...features.keypoints import Keypoints
from ...features.learned import CROSS_MODAL
from ...features.matches import Evidence, TwoViewGeometry
from ...geometry.estimation import TwoViewModel
from ...geometry.images import downscale, zncc_at_points
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
"""Number of learned keypoints, used if SIFT's keypoints show no geometry. Chosen by hand."""

COARSE_SIDE_PX, COARSE_KEYPOINTS = 640, 2000
"""Longer side and keypoints of the copies for the coarse pass. Chosen on the data named above."""

MIN_COARSE_INLIERS = 50
"""The coarse pass, or given points, decide if this many matches agree with a homography."""

MIN_COARSE_DEPTH_INLIERS = 200
"""Inliers of a fundamental matrix for the coarse pass to decide. Chosen on the data named above."""

MIN_COARSE_FRACTION = 0.5
"""Fraction of the coarse matches that must also agree. Chosen on the data named above."""

SIMULATED_SIDE_PX, SIMULATED_KEYPOINTS = 320, 1000
"""Longer side and keypoints of images to be tilted. Views get half the keypoints. Chosen by
hand."""

WINDOW_PX = 16
"""Side of the windows around matches that are checked for inverted brightness. Chosen by hand."""

MIN_GAIN = 1.2
"""Images are from two sensors if cross-modal descriptors give this many times the tentative matches
of learned ones. The ratio is 1.5 to 30 for visible and infrared light, up to 1.17 for pairs of
photographs."""

MIN_INVERTED = 0.05
"""Images are also from two sensors if this fraction of the inliers is dark in one and bright in the
other. Wide pairs of the KITTI clips have up to 0.04, from wrong matches."""

MAX_LEARNED_LOG10_NFA, MAX_CROSS_MODAL_LOG10_NFA = -10.0, -22.0
"""The log10 number of false alarms must be below the first if only learned descriptors show a
geometry, below the second if only cross-modal ones do. Networks also see the borders of images,
which lie in the same places. Unrelated photographs reach -8 with learned descriptors. With
cross-modal ones, noise of 320x240 pixels reaches -20, visible and infrared light -24 or less."""

MAX_MATCHES_TO_SEARCH = 200
"""A fundamental matrix with fewer inliers leads to a search for more along its lines."""

MAX_HINT_LOG10_NFA = 0.0
"""If the log10 number of false alarms of the best geometry is below this, it may be more than
chance: further matches along epipolar lines are counted."""


Source = TentativeMatches | Pair | tuple[Keypoints, Keypoints] | None
"""What a geometry is found from: tentative matches, positions of another matcher's matches ((K, 2)
in both images), or keypoints of both images. Given keypoints are matched only if they are enough
points of all scales. Otherwise, and for None, SIFT keypoints are matched."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InitialGeometry(TwoViewModel):
    """A model of tentative matches, at the images' own size; "none" if none can be trusted.

    `points0` and `points1` are its inliers, `others` the outliers, or None if the caller prescribed
    the model. `num_views` views were simulated. Another model can be estimated from the same
    `source`. A `learned` geometry comes from learned points, a `cross_modal` one from two sensors.
    """

    points0: np.ndarray
    points1: np.ndarray
    others: Pair | None
    num_views: int = 0
    source: Source = None
    learned: bool = False
    cross_modal: bool = False

    @classmethod
    def of(
        cls, model: TwoViewModel, points0: np.ndarray, points1: np.ndarray, asked: str
    ) -> InitialGeometry:
        """Return a model with its inliers and outliers; `asked` is the caller's `model`."""
        agreeing, rest = model.inliers, ~model.inliers
        others = (points0[rest], points1[rest]) if asked == "auto" else None
        return cls(
            **vars(model), points0=points0[agreeing], points1=points1[agreeing], others=others
        )

    @property
    def all_points(self) -> Pair:
        """Positions of all matches, inliers first."""
        assert self.others is not None
        points0, points1 = self.others
        return np.concatenate([self.points0, points0]), np.concatenate([self.points1, points1])

    def untrusted(self) -> InitialGeometry:
        """Return a geometry that cannot be trusted, with the same number of false alarms."""
        nowhere = np.empty((0, 2))
        return replace(self, model="none", matrix=None, points0=nowhere, points1=nowhere)

    def only_below(self, max_log10_nfa: float) -> InitialGeometry:
        """Return the geometry itself if it can be trusted, otherwise an untrusted one."""
        return self if self.log10_nfa < max_log10_nfa else self.untrusted()

    def rescaled(self, scale0: float, scale1: float) -> InitialGeometry:
        """Convert the geometry of scaled images to that of the images themselves."""
        assert self.matrix is not None
        convert = scaled_homography if self.model == "homography" else scaled_fundamental
        return replace(
            self,
            matrix=convert(self.matrix, 1 / scale0, 1 / scale1),
            points0=scaled_points(self.points0, 1 / scale0),
            points1=scaled_points(self.points1, 1 / scale1),
            others=self.others
            and (
                scaled_points(self.others[0], 1 / scale0),
                scaled_points(self.others[1], 1 / scale1),
            ),
        )

    def as_two_view_geometry(self) -> TwoViewGeometry:
        """Return the geometry in its public form."""
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
    """Find the geometry from points with learned descriptors, also between different sensors.

    In different light, in the dark, under blur or from another side, these points have two to
    fifteen times as many inliers as SIFT's keypoints. SIFT has more if one image is four times as
    large. SIFT's positions are more exact, which helps to tell depth from a plane.
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
    """Return whether some inliers are dark in one image and bright in the other."""
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
    """Return whether enough matches of the coarse pass, and most of them, agree with the model."""
    depth = geometry.model == "fundamental"
    least = MIN_COARSE_DEPTH_INLIERS if depth else MIN_COARSE_INLIERS
    most = len(geometry.points0) >= max(least, MIN_COARSE_FRACTION * len(geometry.inliers))
    return geometry.matrix is not None and most


def _geometry_of_positions(grays: Pair, points: Pair, model: str, seed: int) -> InitialGeometry:
    """Estimate the geometry from sparse matches of another matcher, some of them wrong."""
    # The thresholds were chosen for images of this size.
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
    """Estimate the geometry of a pair from its tentative matches and those of simulated views.

    Each view has `view_keypoints` keypoints; 0 simulates no views. For the other arguments see
    `choose_model`.
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
    """Return all matches with those of simulated views: positions, ratios, number of views."""
    found = [(*tentative.matched, tentative.ratios)]
    for side, seen in simulated_views(tentative.views, view_keypoints):
        further = match_sparse(seen, tentative.features[1 - side])
        found.append((further[side], further[1 - side], further[2]))
    points0, points1, ratios = separate(*map(np.concatenate, zip(*found, strict=True)))
    return (points0, points1), ratios, len(found) - 1


def _with_further_evidence(
    geometry: InitialGeometry, used: np.ndarray, tentative: TentativeMatches
) -> InitialGeometry:
    """Let keypoints that are not yet matched decide if a fundamental matrix is in doubt."""
    doubtful = not geometry.trusted and geometry.log10_nfa < MAX_HINT_LOG10_NFA
    if geometry.model != "fundamental" or not doubtful:
        return geometry
    assert geometry.matrix is not None
    chance = log10_p_value(*tentative.features, geometry.matrix, used)
    return replace(geometry, log10_nfa=geometry.log10_nfa + chance)


def _with_further_matches(
    geometry: InitialGeometry, tentative: TentativeMatches
) -> InitialGeometry:
    """Search along the lines of a fundamental matrix that has few inliers, and refit it."""
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
