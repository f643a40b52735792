"""Guided matching: an initial geometry, refined, then all keypoints where it predicts them.

Geometry only proposes. A pair is kept when its patches are the same once the geometry is taken out
(`verification`), or when it is the best on its row in both images (`rectified`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...features.keypoints import Keypoints, nearest_keypoints
from ...features.matches import GuidedMatches, TwoViewGeometry
from .homography import (
    match_by_homography,
    refine_guiding_homography,
)
from .initial_geometry import (
    MIN_COARSE_INLIERS,
    MIN_PARALLAX_FRACTION,
    InitialGeometry,
    estimate_initial_geometry,
    find_initial_geometry,
    geometry_of_points,
)
from .rectified import match_by_rectification
from .tentative_matches import Points, TentativeMatches, matches_of_points

MIN_VERIFIED_FRACTION = 0.5
"""Of what a homography proposes, this must be the same patches: with less, little of the scene lies
on the plane."""

MIN_VERIFIED_FRACTION_OF_DEPTH = 0.6
"""The same where matches off the plane agree on an epipole."""

MIN_MATCHED_FRACTION = 0.02
"""With a smaller fraction of the keypoints of a scene with depth matched, only the sparse matches
that agree with its geometry are taken."""

MIN_MATCHES = 8
"""With fewer the geometry is not trusted after all."""


def guided_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    xy1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    tentative: TentativeMatches | Points | None = None,
    points: tuple[Keypoints, Keypoints] | None = None,
    first: InitialGeometry | None = None,
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Match the keypoints of two images by their geometry.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0, xy1: (N, 2), (M, 2) keypoints on whole pixels.
        model: "homography", "fundamental" or "auto".
        seed: of all random choices.
        tentative: sparse matches of the pair, where `find_tentative_matches` has made them
            already, or (K, 2) positions in both images that take the place of our own.
        points: keypoints of both images, best first; where they have sizes and angles and are
            enough, the sparse matches are made of them.
        first: the geometry to begin with, where `guiding_geometry` has found it already.

    Returns:
        The geometry that guided, and the matches; None when no geometry could be trusted.

    Raises:
        OptionError: the model is unknown, or the positions are no matches.
    """
    if first is None:
        first = guiding_geometry(gray0, gray1, model, seed, tentative, points)
    if first.matrix is None:
        return first.as_two_view_geometry(), None
    enough = MIN_MATCHED_FRACTION * min(len(xy0), len(xy1))
    matrix: np.ndarray = first.matrix
    found = None
    if first.model == "homography":
        matrix, found = _match_plane((gray0, gray1, xy0, xy1), first, seed)
        if found is None:
            known = first.tentative if tentative is None else tentative
            depth = guiding_geometry(gray0, gray1, "fundamental", seed, known, points)
            first = replace(depth, num_views=depth.num_views + first.num_views)
            if first.matrix is None:
                return first.untrusted().as_two_view_geometry(), None
        elif len(found) < enough:
            return first.untrusted().as_two_view_geometry(), None
    if found is None:
        assert first.matrix is not None
        made = match_by_rectification(gray0, gray1, xy0, first.points0, first.points1, first.matrix)
        if made is None or len(made[1]) < enough:
            # Too little around the sparse matches is alike, but they are distinct, and agree.
            matrix, found = first.matrix, _sparse_matches(gray0, xy0, first)
        else:
            matrix, found = made
    if len(found) < MIN_MATCHES:
        return first.untrusted().as_two_view_geometry(), None
    return replace(first, matrix=matrix).as_two_view_geometry(), found


def guiding_geometry(
    gray0: np.ndarray,
    gray1: np.ndarray,
    model: str = "auto",
    seed: int = 0,
    tentative: TentativeMatches | Points | None = None,
    points: tuple[Keypoints, Keypoints] | None = None,
) -> InitialGeometry:
    """Return the geometry to begin with: of given matches, of points where enough, else of SIFT.

    Arguments and errors are those of `guided_matches`.
    """
    if tentative is not None and not isinstance(tentative, TentativeMatches):
        sizes = gray0.shape[::-1], gray1.shape[::-1]
        return geometry_of_points(tentative, sizes, model, seed)
    if tentative is None and points is not None:
        matches = matches_of_points(gray0, gray1, points)
        if matches is not None:
            found = estimate_initial_geometry(matches, model, seed)
            if len(found.points0) >= MIN_COARSE_INLIERS:
                return found
    return find_initial_geometry(gray0, gray1, model, seed, tentative)


def _match_plane(
    pair: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], first: InitialGeometry, seed: int
) -> tuple[np.ndarray, GuidedMatches | None]:
    """Match by a homography; None where the images show that the scene is no plane."""
    assert first.matrix is not None
    matrix = refine_guiding_homography(pair[0], pair[1], first.matrix)
    found, verified = match_by_homography(*pair, matrix, seed)
    parallax = first.parallax
    least = 0.0  # a homography was asked for
    if parallax is not None:
        doubtful = parallax.exceeds(MIN_PARALLAX_FRACTION)
        least = MIN_VERIFIED_FRACTION_OF_DEPTH if doubtful else MIN_VERIFIED_FRACTION
    return matrix, found if verified >= least else None


def _sparse_matches(gray0: np.ndarray, xy0: np.ndarray, first: InitialGeometry) -> GuidedMatches:
    """Return the sparse matches that agree with the geometry, moved to the keypoints near them."""
    height, width = gray0.shape
    rows, distances = nearest_keypoints(first.points0, xy0, (width, height))
    near = np.isfinite(distances)
    moved = first.points1[near] + xy0[rows[near]] - first.points0[near]
    rows, order = np.unique(rows[near].astype(np.int64), return_index=True)
    return GuidedMatches(rows, moved[order], np.full(len(rows), 0.5, np.float32))
