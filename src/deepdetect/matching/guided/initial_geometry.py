"""The initial geometry of a pair, from tentative matches, or that none can be trusted.

A coarse pass on small copies first, which is enough where the pair is clearly a plane or clearly
has depth; then plain SIFT on larger ones; simulated views (`asift`) only when that gives nothing.
Which model it is decides `geometry.two_view`; its thresholds and those here were chosen on all of
Oxford and Middlebury, Strecha's fountain and a KITTI clip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..._shared.errors import OptionError, unknown_name
from ...features.matches import TwoViewGeometry
from ...geometry.estimation import MAX_LOG10_NFA, Parallax, TwoViewModel
from ...geometry.semi_calibrated import MATCH_SIGMA_PX, refine_fundamental
from ...geometry.transforms import (
    epipolar_errors,
    scaled_fundamental,
    scaled_homography,
    scaled_points,
)
from ...geometry.two_view import GUIDING_THRESHOLDS_PX, choose_model
from .asift import TILTS, simulated_views
from .epipolar_search import epipolar_search, log10_p_value
from .tentative_matches import (
    MAX_KEYPOINTS,
    MAX_RATIOS,
    MAX_SIDE_PX,
    Points,
    TentativeMatches,
    find_tentative_matches,
    match_sparse,
    separate,
)

MODELS = ("auto", "homography", "fundamental")

Size = tuple[int, int]

COARSE_SIDE_PX, COARSE_KEYPOINTS = 640, 2000
"""Longer side of the copies of the coarse pass, and keypoints of each."""

MIN_COARSE_INLIERS = 50
"""Matches of the coarse pass that agree with a homography, for it to decide; points as well."""

MIN_COARSE_DEPTH_INLIERS = 200
"""The same of a fundamental matrix."""

MIN_COARSE_FRACTION = 0.5
"""Of the matches of the coarse pass that must agree as well."""

MIN_PARALLAX_FRACTION = 0.1
"""With as many matches that agree on an epipole off the plane, relative to those on it, the coarse
pass does not decide, and a plane must be verified better."""

SIMULATED_SIDE_PX, SIMULATED_KEYPOINTS = 320, 1000
"""Longer side and keypoints of images of which views are simulated; each view gets half as many."""

MAX_MATCHES_TO_SEARCH = 200
"""With fewer that agree with a fundamental matrix, it looks for more along its lines."""

MAX_HINT_LOG10_NFA = 0.0
"""Where the logarithm of the number of false alarms of the best geometry so far is below this, it
may be more than chance: views of a larger tilt are simulated, and further matches along epipolar
lines are counted."""


@dataclass(frozen=True, eq=False)
class InitialGeometry:
    """A geometry from tentative matches.

    Attributes:
        model: "homography", "fundamental", or "none" when no geometry can be trusted.
        matrix: (3, 3) float64 at the images' own size, or None.
        points0, points1: (M, 2) the matches that agree with it, at the images' own size.
        num_matches: tentative matches that it was estimated from.
        log10_nfa: decimal logarithm of its number of false alarms.
        num_views: simulated views that it took.
        parallax: of a homography that was chosen, not asked for: what it leaves.
        tentative: the matches of the larger images, where they have been made.
    """

    model: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    num_matches: int
    log10_nfa: float
    num_views: int = 0
    parallax: Parallax | None = None
    tentative: TentativeMatches | None = None

    @classmethod
    def of(cls, found: TwoViewModel, points: Points) -> InitialGeometry:
        """Return a model with the matches that agree with it."""
        on_model = points[0][found.inliers], points[1][found.inliers]
        num_matches = len(found.inliers)
        return cls(
            *(found.model, found.matrix, *on_model, num_matches, found.log10_nfa),
            parallax=found.parallax,
        )

    @property
    def trusted(self) -> bool:
        """Whether chance does not explain it."""
        return self.log10_nfa < MAX_LOG10_NFA

    def untrusted(self) -> InitialGeometry:
        """Return that there is none, and how near it was."""
        nowhere = np.empty((0, 2))
        return InitialGeometry(
            "none", None, nowhere, nowhere, self.num_matches, self.log10_nfa, self.num_views
        )

    def rescaled(self, scale0: float, scale1: float) -> InitialGeometry:
        """Return a geometry of images at other scales as one of the images themselves."""
        assert self.matrix is not None
        convert = scaled_homography if self.model == "homography" else scaled_fundamental
        return replace(
            self,
            matrix=convert(self.matrix, 1 / scale0, 1 / scale1),
            points0=scaled_points(self.points0, 1 / scale0),
            points1=scaled_points(self.points1, 1 / scale1),
        )

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
    tentative: TentativeMatches | None = None,
) -> InitialGeometry:
    """Find the geometry of a pair, by the least effort that it takes.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        model: as of `estimate_initial_geometry`.
        seed: of the random samples.
        tentative: matches, where `find_tentative_matches` has made them already.

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
    if tentative is None and longest > COARSE_SIDE_PX and model != "fundamental":
        coarse = find_tentative_matches(
            gray0, gray1, max_side_px=COARSE_SIDE_PX, max_keypoints=COARSE_KEYPOINTS
        )
        found = estimate_initial_geometry(coarse, model, seed, semi_calibrated=False)
        if _is_clear(found):
            return found
    if tentative is None:
        tentative = find_tentative_matches(gray0, gray1)
    found = estimate_initial_geometry(tentative, model, seed)
    if found.matrix is not None:
        return replace(found, tentative=tentative)
    if longest <= SIMULATED_SIDE_PX:
        return estimate_initial_geometry(tentative, model, seed, view_keypoints=MAX_KEYPOINTS // 2)
    tentative = find_tentative_matches(
        gray0, gray1, max_side_px=SIMULATED_SIDE_PX, max_keypoints=SIMULATED_KEYPOINTS
    )
    return estimate_initial_geometry(
        tentative, model, seed, semi_calibrated=False, view_keypoints=SIMULATED_KEYPOINTS // 2
    )


def geometry_of_points(
    points: Points, sizes: tuple[Size, Size], model: str = "auto", seed: int = 0
) -> InitialGeometry:
    """Estimate the geometry of a pair from sparse matches that were found elsewhere.

    Args:
        points: (K, 2) positions in both images, some of them wrong.
        sizes: (width, height) of both images.
        model: as of `estimate_initial_geometry`.
        seed: of the random samples.

    Returns:
        The geometry, or one with the model "none".

    Raises:
        OptionError: the model is unknown, or these are not two (K, 2) arrays of finite numbers.

    Example:
        >>> points = np.random.default_rng(0).uniform(0, 99, (30, 2))
        >>> found = geometry_of_points((points, points + 3), ((110, 110), (110, 110)))
        >>> found.matrix[:2, 2].round(3)
        array([3., 3.])
    """
    check_model(model)
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
    # The thresholds hold for images of this size.
    scale0, scale1 = (min(1.0, MAX_SIDE_PX / max(size)) for size in sizes)
    size0, size1 = (
        (round(size[0] * scale), round(size[1] * scale))
        for size, scale in zip(sizes, (scale0, scale1), strict=True)
    )
    scaled0, scaled1 = separate(scaled_points(points0, scale0), scaled_points(points1, scale1))
    chosen = choose_model(scaled0, scaled1, (size0, size1), model, seed)
    found = InitialGeometry.of(chosen, (scaled0, scaled1))
    return found.rescaled(scale0, scale1) if found.trusted else found.untrusted()


def estimate_initial_geometry(
    tentative: TentativeMatches,
    model: str = "auto",
    seed: int = 0,
    *,
    semi_calibrated: bool = True,
    view_keypoints: int = 0,
) -> InitialGeometry:
    """Estimate the geometry of a pair from its tentative matches, and those of simulated views.

    Args:
        tentative: the matches.
        model: "homography", "fundamental", or "auto": the homography, but the fundamental matrix
            where the matches alone show depth (`Parallax.shows_depth`).
        seed: of the random samples.
        semi_calibrated: whether a fundamental matrix may assume cameras as most are; for small
            copies that would take as long as the rest.
        view_keypoints: of each view that is simulated where the matches alone give nothing; 0:
            none is simulated.

    Returns:
        The geometry, or one with the model "none".

    Raises:
        OptionError: the model is unknown.
    """
    check_model(model)
    size0, size1 = ((view.shape[1], view.shape[0]) for view in tentative.views)
    nowhere = np.empty((0, 2))
    best = InitialGeometry("none", None, nowhere, nowhere, 0, float("inf"))
    num_views = 0
    for points, ratios, views in _more_and_more_matches(tentative, view_keypoints):
        num_views += views
        for ratio in MAX_RATIOS:
            chosen = points[0][ratios < ratio], points[1][ratios < ratio]
            two_view = choose_model(*chosen, (size0, size1), model, seed, semi_calibrated)
            found = InitialGeometry.of(two_view, chosen)
            found = _with_further_evidence(found, chosen[0], tentative)
            if found.log10_nfa < best.log10_nfa:
                best = replace(found, num_views=num_views)
            if best.trusted:
                best = _with_further_matches(best, tentative, (size0, size1))
                return best.rescaled(*tentative.scales)
        if num_views and best.log10_nfa > MAX_HINT_LOG10_NFA:
            break
    return replace(best, num_views=num_views).untrusted()


def check_model(model: str) -> None:
    """Raise `OptionError` unless a model is known."""
    if model not in MODELS:
        raise unknown_name("model", model, MODELS)


def _is_clear(found: InitialGeometry) -> bool:
    """Whether most matches of the coarse pass, and enough, agree with a model that fits alone."""
    depth = found.model == "fundamental"
    least = MIN_COARSE_DEPTH_INLIERS if depth else MIN_COARSE_INLIERS
    most = len(found.points0) >= max(least, MIN_COARSE_FRACTION * found.num_matches)
    parallax = found.parallax
    doubtful = parallax is not None and parallax.exceeds(MIN_PARALLAX_FRACTION)
    return found.matrix is not None and most and (depth or not doubtful)


def _more_and_more_matches(
    tentative: TentativeMatches, view_keypoints: int
) -> Iterator[tuple[Points, np.ndarray, int]]:
    """Yield matched positions, ratios and the number of simulated views, up to strong tilts."""
    (points0, points1), ratios = tentative.matched, tentative.ratios
    yield (points0, points1), ratios, 0
    for tilt in TILTS if view_keypoints else ():
        views = 0
        for side in (0, 1):
            other = tentative.features[1 - side]
            for seen in simulated_views(tentative.views[side], tilt, view_keypoints):
                found = match_sparse(seen, other)
                points0 = np.concatenate([points0, found[side]])
                points1 = np.concatenate([points1, found[1 - side]])
                ratios = np.concatenate([ratios, found[2]])
                views += 1
        points0, points1, ratios = separate(points0, points1, ratios)
        yield (points0, points1), ratios, views


def _with_further_evidence(
    found: InitialGeometry, used: np.ndarray, tentative: TentativeMatches
) -> InitialGeometry:
    """Let keypoints that no match was made of decide where a fundamental matrix is in doubt."""
    doubtful = not found.trusted and found.log10_nfa < MAX_HINT_LOG10_NFA
    if found.model != "fundamental" or not doubtful:
        return found
    assert found.matrix is not None
    chance = log10_p_value(*tentative.features, found.matrix, used)
    return replace(found, log10_nfa=found.log10_nfa + chance)


def _with_further_matches(
    found: InitialGeometry, tentative: TentativeMatches, sizes: tuple[Size, Size]
) -> InitialGeometry:
    """Search along the lines of a fundamental matrix that few matches agree with, and refit it."""
    if found.model != "fundamental" or len(found.points0) >= MAX_MATCHES_TO_SEARCH:
        return found
    assert found.matrix is not None
    further = epipolar_search(*tentative.features, found.matrix)
    points0, points1 = separate(
        np.concatenate([found.points0, further[0]]), np.concatenate([found.points1, further[1]])
    )
    sigmas = np.full(len(points0), MATCH_SIGMA_PX)
    matrix = refine_fundamental(points0, points1, found.matrix, sizes, sigmas)
    inliers = epipolar_errors(points0, points1, matrix) < GUIDING_THRESHOLDS_PX["fundamental"]
    if np.count_nonzero(inliers) <= len(found.points0):
        return found
    return replace(found, matrix=matrix, points0=points0[inliers], points1=points1[inliers])
