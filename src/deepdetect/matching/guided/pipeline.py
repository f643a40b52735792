"""Guided matching: an initial geometry, refined, then all keypoints where it predicts them.

Geometry only proposes. A pair is kept when its patches are the same once the geometry is taken out
(`verification`), or when it is the best on its row in both images (`rectified`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...features.keypoints import Keypoints
from ...features.matchers import DescriptorMatches
from ...features.matches import GuidedMatches, TwoViewGeometry
from .homography import (
    ImagePair,
    match_by_homography,
    nearest_keypoint,
    refine_guiding_homography,
)
from .initial_geometry import (
    InitialGeometry,
    estimate_initial_geometry,
    find_initial_geometry,
    geometry_of_points,
)
from .options import GuidedOptions
from .rectified import match_by_rectification
from .sparse_matches import Points, TentativeMatches, matches_of_points


def guided_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    tentative: Points | TentativeMatches | None = None,
    options: GuidedOptions = GuidedOptions(),
    points: tuple[Keypoints, Keypoints] | None = None,
    first: InitialGeometry | None = None,
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Match the keypoints of two images by their geometry.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        model: "homography", "fundamental" or "auto".
        seed: of all random choices.
        tentative: matches of the pair, where `tentative_matches` has made them already; or two
            (K, 2) arrays of positions, which take the place of these.
        options: all tuned numbers.
        points: keypoints of both images, best first; where they have sizes and angles and are
            enough, the sparse matches are made of them.
        first: the geometry to begin with, where `guiding_geometry` has found it already.

    Returns:
        The geometry that guided, and the matches; None when no geometry could be trusted.

    Raises:
        OptionError: the model is unknown, or the tentative matches are none.
    """
    if first is None:
        first = guiding_geometry(gray0, gray1, model, seed, tentative, options, points)
    if first.matrix is None:
        return first.as_two_view_geometry(), None
    pair = ImagePair(gray0, gray1, xy0, xy1)
    matrix, found = first.matrix, None
    if first.model == "homography":
        matrix, found = _match_plane(pair, first, options, seed)
        if found is None:
            views = first.num_views
            known = first.initial if tentative is None else tentative
            first = guiding_geometry(gray0, gray1, "fundamental", seed, known, options, points)
            first = replace(first, num_views=first.num_views + views)
            if first.matrix is None:
                return _no_guide(first), None
    enough = options.min_matched_fraction * min(len(xy0), len(xy1))
    if found is not None and len(found) < enough:
        return _no_guide(first), None
    if found is None:
        matrix, found = _match_scene_with_depth(pair, first, options, seed)
    if len(found) < options.min_matches:
        return _no_guide(first), None
    return replace(first, matrix=matrix).as_two_view_geometry(), found


def guiding_geometry(
    gray0: np.ndarray,
    gray1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    tentative: Points | TentativeMatches | None = None,
    options: GuidedOptions = GuidedOptions(),
    points: tuple[Keypoints, Keypoints] | None = None,
) -> InitialGeometry:
    """Return the geometry to begin with: of given matches, of enough points, else of SIFT's.

    Arguments and errors are those of `guided_matches`.
    """
    chosen = options.initial_geometry
    if isinstance(tentative, tuple):
        sizes = gray0.shape[::-1], gray1.shape[::-1]
        return geometry_of_points(tentative, sizes, model, seed, chosen)
    if tentative is None and points is not None:
        matches = matches_of_points(gray0, gray1, points, chosen)
        if matches is not None:
            found = estimate_initial_geometry(matches, model, seed, chosen, simulate_views=False)
            if len(found.points0) >= chosen.min_first_inliers:
                return found
    return find_initial_geometry(gray0, gray1, model, seed, chosen, tentative)


def _match_plane(
    pair: ImagePair, first: InitialGeometry, options: GuidedOptions, seed: int
) -> tuple[np.ndarray, GuidedMatches | None]:
    """Match by a homography; None where the images show that the scene is no plane."""
    assert first.matrix is not None
    plane = options.homography_matching
    matrix = refine_guiding_homography(pair.gray0, pair.gray1, first.matrix, plane)
    matches, verified = match_by_homography(pair, matrix, plane, options.verification, seed)
    found = _at_keypoints(pair, matches)
    parallax = first.parallax
    if parallax is None:  # a homography was asked for
        return matrix, found
    seen = parallax.is_seen(options.initial_geometry.model_selection)
    agree = parallax.agreeing >= plane.min_parallax_fraction * parallax.on_plane
    least = plane.min_verified_fraction
    if seen and agree:
        least = max(least, plane.min_verified_fraction_of_depth)
    return matrix, found if verified >= least else None


def _match_scene_with_depth(
    pair: ImagePair, first: InitialGeometry, options: GuidedOptions, seed: int
) -> tuple[np.ndarray, GuidedMatches]:
    """Match by rectification; where that finds too little, return the sparse matches that agree.

    Then too little around them is alike, but they themselves are distinct, and agree.
    """
    assert first.matrix is not None
    found = match_by_rectification(
        pair.gray0,
        pair.gray1,
        pair.xy0,
        first.points0,
        first.points1,
        first.matrix,
        options.rectified_matching,
    )
    enough = options.min_matched_fraction * min(len(pair.xy0), len(pair.xy1))
    if found is None or len(found[1]) < enough:
        return first.matrix, _sparse_matches(pair, first)
    return found


def _sparse_matches(pair: ImagePair, first: InitialGeometry) -> GuidedMatches:
    """Return the sparse matches that agree with the geometry, moved to the keypoints near them."""
    height, width = pair.gray0.shape
    rows, distances = nearest_keypoint(first.points0, pair.xy0, (width, height))
    near = np.isfinite(distances)
    moved = first.points1[near] + pair.xy0[rows[near]] - first.points0[near]
    found = GuidedMatches(
        rows[near].astype(np.int64), moved, np.full(np.count_nonzero(near), 0.5, np.float32)
    )
    order = np.unique(found.indices0, return_index=True)[1]
    return GuidedMatches(found.indices0[order], found.points1[order], found.scores[order])


def _at_keypoints(pair: ImagePair, found: DescriptorMatches) -> GuidedMatches:
    scores = np.clip(1 - found.ratios, 0, 1)
    places = pair.xy1[found.indices1].astype(np.float64)
    return GuidedMatches(found.indices0, places, scores, indices1=found.indices1)


def _no_guide(first: InitialGeometry) -> TwoViewGeometry:
    return replace(
        first, model="none", matrix=None, points0=first.points0[:0]
    ).as_two_view_geometry()
