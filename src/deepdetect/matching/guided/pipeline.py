"""Guided matching: an initial geometry is refined and predicts the partner of every keypoint.

The geometry only proposes matches. A match by a homography is kept if both patches look the same
once the images are aligned (`verification`). A match by a fundamental matrix is kept if each pixel
is the best for the other on their common row of the rectified images (`rectified`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from ..._shared.opencv import cv2
from ...features.keypoints import nearest_keypoints
from ...features.matches import GuidedMatches, TwoViewGeometry
from ...geometry.estimation import TwoViewModel, estimate_geometry, measure_parallax
from ...geometry.homography_refinement import most_alike, refine_homography
from ...geometry.images import downscale, edge_strength, median_local_zncc, warp_to_reference
from ...geometry.transforms import (
    epipolar_errors,
    scaled_homography,
    transfer_errors,
    transform_points,
)
from ...geometry.two_view import (
    GUIDING_THRESHOLDS_PX,
    MIN_PLANAR_RATIO,
    fit_model,
    is_usual_rotation,
)
from .evidence import OFF_PLANE_PX, compare_held_out, is_repeated, moving_alike
from .initial_geometry import InitialGeometry, guiding_geometry
from .rectified import match_by_rectification
from .tentative_matches import Pair
from .verification import dissimilarity

MIN_VERIFIED_FRACTION = 0.5
"""The scene counts as planar if at least this fraction of the matches that a homography proposes is
verified. Chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip."""

MIN_UNMATCHED_FRACTION = 0.5
"""A further plane needs at least this fraction of its matches where nothing is matched yet. A
shifted copy of a repeated pattern only gives matches where the pattern is already matched."""

MATCHED_PX = 9
"""Side of the window around a match in which the first image counts as matched. Chosen by hand."""

MIN_OFF_PLANE_FRACTION = 0.02
"""A scene with a plane has depth if the dense matches off the plane are at least this fraction of
those on it. The fraction is up to 0.013 for the planar scenes of Oxford, which are not quite flat,
and 0.032 or more for facades. Sparse matches and compared patches must pass the same test."""

MAX_MOVING_PLANES = 3
"""Maximum number of planes that are tested for a motion of their own. One is not enough, because
the first may belong to the static scene."""

MIN_ON_LINES = 0.33
"""A plane is static if at least this fraction of its matches lies on the epipolar lines of the rest
of the scene. The fraction is up to 0.3 for planes that were pasted into scenes with depth."""

MIN_REST_FRACTION, MIN_REST_RATIO = 0.5, 1.05
"""If a plane moves on its own, the rest of the scene may get its own fundamental matrix. This
matrix must fit at least the first fraction of the rest's matches, and more than the second value
times as many of them as the common matrix of all matches. Chosen by hand."""

MAX_REST_LOG10_NFA = -20.0
"""Apart from a moving plane, a scene has depth if its matches agree on an epipole, relative to
their largest plane, with a log10 number of false alarms below this. A plane alone has -7."""

MAX_PARALLAX_LOG10_NFA = -40.0
"""Sparse matches off the plane also prove depth if they agree on an epipole with a log10 number of
false alarms below this. It is -22 or more for the planar scenes of Oxford, and -84 for Strecha's
scene "entry", which is nearly all wall."""

SCENE_MATCHES = 1000
"""Number of random dense matches from which the type of a scene is determined. Chosen by hand."""

DOMINANT_FRACTION, MIN_PLANE_FRACTION = 0.5, 0.2
"""A plane is dominant if at least the first fraction of the `SCENE_MATCHES` lies on it. It is
tested for repeated patterns if at least the second fraction does. Chosen by hand."""

MAX_CLEAR_LOG10_NFA, MIN_CLEAR_CORRELATION = -12.0, 0.5
"""The confidence is "high" only if the log10 number of false alarms is below the first value, and
the correlation of held-out windows above the second. Chosen by hand."""

MIN_OWN_FRACTION = 0.67
"""High confidence also needs at least this fraction of all matches to follow the geometry. The
others lie on planes that move differently, such as an overlay that stands still."""

MIN_MATCHED_FRACTION = 0.02
"""Dense matching has failed if it matches less than this fraction of the keypoints. For a scene
with depth, the sparse matches that agree with its geometry are then returned. Chosen by hand."""

MIN_MATCHES = 8
"""A geometry that gives fewer final matches than this is rejected. Chosen by hand."""

MIN_MOVING_ALIKE = 0.6
"""A sparse match is verified if this fraction of its neighbours moves like it. Chosen by hand."""

MIN_ALIKE_FRACTION = 0.3
"""Sparse matches are returned only if at least this fraction of them is verified. At random places,
up to a tenth of the matches is verified."""

MAX_DISTANCE_PX = 1.0
"""A keypoint of the second image may be a partner if it is nearer than this to the place where the
homography maps the keypoint of the first image. Chosen by hand."""

MIN_PROPOSED_FRACTION = 0.25
"""If fewer than this fraction of the visible keypoints have a partner under the homography, the
keypoints are sparse, and all visible keypoints are verified. Chosen by hand."""

MAX_VERIFIED_PIXELS = 6e6
"""Images with more pixels than this are scaled down to it for verification, to save memory."""

MAX_REFINED_SIDE_PX = 1600
"""Images are reduced to this longer side while the homography is refined. Chosen by hand."""

MAX_SCALE_RATIO = 1.5
"""If the scales of the two images differ by more than this factor, the finer image is scaled down
while the homography is refined, because corners of different scales lie at different places."""

MIN_SCALE = 1 / 16
"""The finer image is reduced at most to this scale. If scales differ more, refinement fails."""


def guided_matches(
    grays: Pair, pixels: Pair, first: InitialGeometry, seed: int = 0
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Match keypoints on integer pixels, (N, 2) and (M, 2), guided by a `first` geometry.

    Returns the geometry that guided the dense matching, and the matches, which are None if no
    geometry can be trusted.
    """
    enough = MIN_MATCHED_FRACTION * min(len(xy) for xy in pixels)
    if first.cross_modal:
        grays = edge_strength(grays[0]), edge_strength(grays[1])
    if first.model == "homography":
        geometry, matches = _plane_or_depth(grays, pixels, first, enough, seed)
    else:
        apart = _apart_from_plane(grays, first, first, seed)
        ways = ((way, None) for way in (apart, first) if way is not None)
        _, geometry, matches = _first_that_matches(grays, pixels[0], ways, enough)
    if matches is None:
        return geometry, None
    geometry, plane = _with_scene(grays, pixels[0], geometry, matches, seed)
    sparse = None if first.prescribed else first.all_points
    distinct = matches.points0 is not None
    flat = first.prescribed and first.model == "homography"
    if plane is not None and is_repeated(grays, *plane, sparse, seed, distinct, flat):
        return replace(geometry, model="none", matrix=None, scene="none"), None
    own = len(matches)
    matches = _with_further_planes(grays, pixels, geometry, matches, first, enough, seed)
    ends = matches.starts(pixels[0]), matches.points1
    correlation, alike = compare_held_out(grays, *ends)
    evidence = replace(geometry.evidence, correlation=correlation)
    clear = evidence.log10_nfa < MAX_CLEAR_LOG10_NFA and correlation > MIN_CLEAR_CORRELATION
    clear = clear and own >= MIN_OWN_FRACTION * len(matches)
    confidence = "high" if clear and matches.points0 is None else "fair"
    geometry = replace(geometry, confidence=confidence, evidence=evidence)
    return geometry, replace(matches, alike=alike)


def _with_scene(
    grays: Pair, xy0: np.ndarray, geometry: TwoViewGeometry, matches: GuidedMatches, seed: int
) -> tuple[TwoViewGeometry, Pair | None]:
    """Classify the scene by the largest plane in a random sample of the dense matches.

    Returns the geometry with the type of the scene. If the plane has enough matches, also returns
    its matched points in the first image and its homography, otherwise None.
    """
    sizes = grays[0].shape[::-1], grays[1].shape[::-1]
    points0, points1 = matches.starts(xy0).astype(np.float64), matches.points1
    some = np.random.default_rng(seed).permutation(len(points0))[:SCENE_MATCHES]
    if geometry.model == "homography":
        assert geometry.matrix is not None
        rotation = is_usual_rotation(points0[some], points1[some], sizes)
        scene = "rotation" if rotation else "planar"
        evidence = replace(geometry.evidence, on_plane=len(matches))
        return replace(geometry, scene=scene, evidence=evidence), (points0, geometry.matrix)
    proposed = len(xy0) if matches.points0 is None else geometry.evidence.tentative_inliers
    evidence = replace(geometry.evidence, verified=len(matches) / max(proposed, 1))
    geometry = replace(geometry, scene="depth", evidence=evidence)
    plane = _fit(points0[some], points1[some], "homography", grays[1], seed)
    if plane.matrix is None or np.mean(plane.inliers) < MIN_PLANE_FRACTION:
        return geometry, None
    near = transfer_errors(points0, points1, plane.matrix) <= OFF_PLANE_PX
    on = int(np.count_nonzero(near))
    if np.mean(plane.inliers) >= DOMINANT_FRACTION:
        evidence = replace(evidence, on_plane=on, off_plane=len(matches) - on)
        geometry = replace(geometry, scene="depth with a dominant plane", evidence=evidence)
    return geometry, (points0[near], plane.matrix)


def _plane_or_depth(
    grays: Pair, pixels: Pair, first: InitialGeometry, enough: float, seed: int
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Match by a homography, or along epipolar lines if matches off its plane show depth."""
    assert first.matrix is not None
    # On a surface that is not quite flat, the homography fitted to the inliers only can be better.
    consensus = estimate_geometry(first.points0, first.points1, "homography", seed=seed).matrix
    refined = _refine_homography(grays, first.matrix)
    known = [refined, first.matrix, *([] if consensus is None else [consensus])]
    matrix = most_alike(*grays, known)
    on_plane, verified = match_by_homography(grays, pixels, matrix, seed)
    planar = first.parallax is None or verified >= MIN_VERIFIED_FRACTION
    # Points with learned descriptors have less exact positions, which looks like parallax.
    off_plane = first.parallax is not None and first.parallax.significant and not first.learned
    plane = _trusted(first, matrix, on_plane, enough)
    evidence = replace(plane[0].evidence, verified=verified)
    plane = replace(plane[0], evidence=evidence), plane[1]
    if first.cross_modal or first.parallax is None:
        # Patches differ in images of two sensors, and unrelated ones are equal in line drawings.
        if plane[1] is None and first.cross_modal:
            plane = _sparsely(grays[0], pixels[0], first)
        elif plane[1] is None and median_local_zncc(*grays, matrix) > MIN_CLEAR_CORRELATION:
            plane = _sparsely(grays[0], pixels[0], replace(first, matrix=matrix))
        if plane[1] is not None:
            return plane
    clear = first.parallax is not None and first.parallax.log10_nfa < MAX_PARALLAX_LOG10_NFA
    unexplained = 1 - verified >= MIN_OFF_PLANE_FRACTION * verified
    if planar and not (clear or (off_plane and unexplained)):
        return plane
    joint = guiding_geometry(grays, "fundamental", seed, first.source)
    joint = replace(joint, num_views=joint.num_views + first.num_views)
    apart = _apart_from_plane(grays, first, joint, seed)
    points = (apart or joint).points0, (apart or joint).points1
    errors = transfer_errors(*points, matrix)
    if planar and np.count_nonzero(errors > OFF_PLANE_PX) < MIN_OFF_PLANE_FRACTION * len(errors):
        return plane

    def ways() -> Iterator[tuple[InitialGeometry, np.ndarray | None]]:
        if apart is not None:
            yield apart, None
        yield joint, matrix if planar else None
        if not planar and not first.prescribed:
            # If something moves, the matches off the plane alone may give a better matrix.
            yield guiding_geometry(grays, "fundamental", seed, first.others), None

    depth, geometry, matches = _first_that_matches(grays, pixels[0], ways(), enough)
    if matches is None:
        return plane if planar or plane[1] is not None else (geometry, None)
    errors = transfer_errors(matches.starts(pixels[0]), matches.points1, matrix)
    new = ~np.isin(matches.indices0, on_plane.indices0)
    off = int(np.count_nonzero(new & (errors > OFF_PLANE_PX)))
    if planar:
        shown = clear or off >= MIN_OFF_PLANE_FRACTION * len(on_plane)
    else:
        fractions = [len(each.points0) / max(len(each.inliers), 1) for each in (first, depth)]
        shown = fractions[0] < MIN_PLANAR_RATIO * fractions[1]
    return (geometry, matches) if shown or plane[1] is None else plane


def _fit(
    points0: np.ndarray, points1: np.ndarray, model: str, gray1: np.ndarray, seed: int = 0
) -> TwoViewModel:
    """Fit a model to (M, 2) matches with the guiding threshold, even if it cannot be trusted."""
    size1, threshold_px = gray1.shape[::-1], GUIDING_THRESHOLDS_PX[model]
    return fit_model(points0, points1, model, size1, threshold_px, seed)


def _apart_from_plane(
    grays: Pair, first: InitialGeometry, depth: InitialGeometry, seed: int
) -> InitialGeometry | None:
    """Return the geometry of the rest of the scene if a plane moves on its own, otherwise None.

    `depth` is the geometry with the common fundamental matrix of all matches.
    """
    if first.prescribed or depth.matrix is None:
        return None
    points0, points1 = first.all_points
    by_depth = (
        epipolar_errors(points0, points1, depth.matrix) < GUIDING_THRESHOLDS_PX["fundamental"]
    )
    left, apart, spoilt = np.ones(len(points0), bool), None, False
    most = np.count_nonzero(by_depth)
    for _ in range(MAX_MOVING_PLANES):
        plane = _fit(points0[left], points1[left], "homography", grays[1], seed)
        if plane.matrix is None or not plane.trusted:
            break
        on = transfer_errors(points0, points1, plane.matrix) <= OFF_PLANE_PX
        left &= ~on
        rest = _fit(points0[~on], points1[~on], "fundamental", grays[1], seed)
        own = np.count_nonzero(rest.inliers)
        explained = np.count_nonzero(on) + own
        least = MIN_REST_FRACTION * len(rest.inliers)
        if rest.matrix is None or own < least or explained <= most:
            continue
        errors = epipolar_errors(points0[on], points1[on], rest.matrix)
        if np.mean(errors < GUIDING_THRESHOLDS_PX["homography"]) >= MIN_ON_LINES:
            continue
        # The rest of the scene has depth only if matches off its largest plane agree on an epipole.
        rest0, rest1 = points0[~on][rest.inliers], points1[~on][rest.inliers]
        another = _fit(rest0, rest1, "homography", grays[1], seed)
        if another.matrix is None or (
            measure_parallax(rest0, rest1, another.matrix, seed).log10_nfa < MAX_REST_LOG10_NFA
        ):
            apart, most = (points0[~on], points1[~on]), explained
            spoilt = bool(own > MIN_REST_RATIO * np.count_nonzero(by_depth[~on]))
    return guiding_geometry(grays, "fundamental", seed, apart) if apart and spoilt else None


def _with_further_planes(
    grays: Pair,
    pixels: Pair,
    geometry: TwoViewGeometry,
    matches: GuidedMatches,
    first: InitialGeometry,
    enough: float,
    seed: int,
) -> GuidedMatches:
    """Add dense matches of planes that move differently, found from unexplained sparse matches."""
    if first.prescribed or matches.points0 is not None:
        return matches
    assert geometry.matrix is not None
    points0, points1 = first.all_points
    errors = transfer_errors if geometry.model == "homography" else epipolar_errors
    rest = errors(points0, points1, geometry.matrix) > OFF_PLANE_PX
    around = np.zeros(grays[0].shape, np.uint8)
    x, y = pixels[0][matches.indices0].astype(np.int64).T
    around[y, x] = 1
    around = cv2.dilate(around, np.ones((MATCHED_PX, MATCHED_PX)))
    last = np.array(around.shape[::-1]) - 1
    while np.count_nonzero(rest) >= MIN_MATCHES:
        points0, points1 = points0[rest], points1[rest]
        plane = _fit(points0, points1, "homography", grays[1], seed)
        if plane.matrix is None or not plane.trusted:
            break
        rest = ~plane.inliers
        x, y = np.rint(points0[~rest]).clip(0, last).astype(np.int64).T
        if around[y, x].mean() > 1 - MIN_UNMATCHED_FRACTION:
            continue
        matrix = _refine_homography(grays, plane.matrix)
        further, _ = match_by_homography(grays, pixels, matrix, seed)
        new = ~np.isin(further.indices0, matches.indices0)
        if np.count_nonzero(new) < max(enough, MIN_UNMATCHED_FRACTION * len(further)):
            continue
        if not is_repeated(grays, further.starts(pixels[0])[new], matrix):
            matches = matches.joined(further, new)
    return matches


def _first_that_matches(
    grays: Pair,
    xy0: np.ndarray,
    ways: Iterable[tuple[InitialGeometry, np.ndarray | None]],
    enough: float,
) -> tuple[InitialGeometry, TwoViewGeometry, GuidedMatches | None]:
    """Match by one initial geometry after another, until one gives enough matches.

    Each of the `ways` is a geometry and the homography of a plane or None. Returns the geometry
    with the most matches, and its result.
    """
    best, most = None, -1
    for first, plane in ways:
        geometry, matches = _match_depth(grays, xy0, first, enough, plane)
        count = 0 if matches is None else len(matches)
        if count > most:
            best, most = (first, geometry, matches), count
        if count >= enough:
            break
    assert best is not None
    return best


def _match_depth(
    grays: Pair,
    xy0: np.ndarray,
    first: InitialGeometry,
    enough: float,
    plane: np.ndarray | None = None,
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Match keypoints of a scene with depth; `plane` is the homography of a known plane in it."""
    if first.matrix is None:
        return first.untrusted().as_two_view_geometry(), None
    sparse = first.points0, first.points1
    dense = match_by_rectification(grays, xy0, sparse, first.matrix, plane=plane)
    if plane is None and (dense is None or len(dense[1]) < enough):
        # The homography of a large plane makes the views of a wide-baseline pair similar.
        seen = _fit(*sparse, "homography", grays[1])
        if seen.matrix is not None and seen.trusted:
            plane = _refine_homography(grays, seen.matrix)
            dense = match_by_rectification(grays, xy0, sparse, first.matrix, plane=plane)
    if dense is None or len(dense[1]) < enough:
        # The images differ around the sparse matches, but these are distinctive and move alike.
        return _sparsely(grays[0], xy0, first)
    return _trusted(first, *dense, enough)


def _trusted(
    first: InitialGeometry, matrix: np.ndarray, matches: GuidedMatches, least: float
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Return a geometry with its matches, or an untrusted one if there are fewer than `least`."""
    if len(matches) < max(least, MIN_MATCHES):
        return first.untrusted().as_two_view_geometry(), None
    return replace(first, matrix=matrix).as_two_view_geometry(), matches


def _sparsely(
    gray0: np.ndarray, xy0: np.ndarray, first: InitialGeometry
) -> tuple[TwoViewGeometry, GuidedMatches | None]:
    """Return the sparse matches that move as their neighbours do, if enough of them do."""
    assert first.matrix is not None
    scores = moving_alike(first.points0, first.points1)
    kept = scores >= MIN_MOVING_ALIKE
    points0 = first.points0[kept]
    rows, distances = nearest_keypoints(points0, xy0, gray0.shape[::-1])
    rows = np.where(np.isfinite(distances), rows, -1).astype(np.int64)
    ends = first.points1[kept], scores[kept].astype(np.float32)
    matches = GuidedMatches(rows, *ends, subpixel=True, points0=points0)
    return _trusted(first, first.matrix, matches, MIN_ALIKE_FRACTION * len(first.points0))


def match_by_homography(
    grays: Pair, pixels: Pair, homography: np.ndarray, seed: int = 0
) -> tuple[GuidedMatches, float]:
    """Match keypoints by a homography, and keep those whose patches are the same.

    Scores are 1 - `dissimilarity`. Also returns the fraction of the compared keypoints whose
    patches are the same. If few keypoints have a partner under the homography, all keypoints that
    it maps into the second image are compared.
    """
    size1 = grays[1].shape[::-1]
    predicted = transform_points(pixels[0], homography)
    indices1, distances = nearest_keypoints(predicted, pixels[1], size1)
    with np.errstate(invalid="ignore"):
        shown = (predicted > -0.5) & (predicted < np.array(size1) - 0.5)
    near = distances < MAX_DISTANCE_PX
    indices0 = np.flatnonzero(shown.all(axis=1))
    proposed = np.flatnonzero(near)
    # If keypoints are sparse, it is chance which of them have a partner, so all are verified.
    if len(proposed) >= MIN_PROPOSED_FRACTION * len(indices0):
        indices0 = proposed
    ratios = _compare(grays, pixels[0][indices0], homography, seed)
    same = ratios < 1
    kept = same & near[indices0]
    indices0 = indices0[kept]
    indices1 = indices1[indices0]
    scores, ends = np.clip(1 - ratios[kept], 0, 1), pixels[1][indices1].astype(np.float64)
    matches = GuidedMatches(indices0, ends, scores, indices1=indices1)
    return matches, float(same.mean()) if len(same) else 0.0


def _compare(grays: Pair, pixels0: np.ndarray, homography: np.ndarray, seed: int) -> np.ndarray:
    """Return the `dissimilarity` of keypoints; large images are compared on smaller copies."""
    (gray0, scale0), (gray1, scale1) = (
        downscale(gray, round(max(gray.shape) * min(1, np.sqrt(MAX_VERIFIED_PIXELS / gray.size))))
        for gray in grays
    )
    if scale0 < 1 or scale1 < 1:
        homography = scaled_homography(homography, scale0, scale1)
        last = np.array(gray0.shape[::-1], np.float32) - 1
        pixels0 = np.clip(np.rint((pixels0 + np.float32(0.5)) * scale0 - 0.5), 0, last)
    warped, valid = warp_to_reference(gray1, homography, (gray0.shape[1], gray0.shape[0]))
    return dissimilarity(gray0, warped, valid, pixels0, seed)


def _refine_homography(grays: Pair, homography: np.ndarray) -> np.ndarray:
    scales = _scales_at_centre(homography, grays[0].shape)
    (small0, scale0), (small1, scale1) = (
        downscale(gray, min(MAX_REFINED_SIDE_PX, round(max(gray.shape) * scale)))
        for gray, scale in zip(grays, scales, strict=True)
    )
    start = scaled_homography(homography, scale0, scale1)
    return scaled_homography(refine_homography(small0, small1, start), 1 / scale0, 1 / scale1)


def _scales_at_centre(homography: np.ndarray, shape: tuple[int, ...]) -> tuple[float, float]:
    """Return the factors by which to scale the images so that both show equally fine detail.

    The finer image is scaled down if, at the centre of the first image, its scale is larger in
    every direction by a factor of more than `MAX_SCALE_RATIO`.
    """
    centre = np.array([shape[1] / 2, shape[0] / 2])
    around = transform_points(centre + [[0, 0], [1, 0], [0, 1]], homography)
    if not np.isfinite(around).all():
        return 1.0, 1.0
    largest, smallest = np.linalg.svd(around[1:] - around[0], compute_uv=False)
    if largest * MAX_SCALE_RATIO < 1:
        return max(float(largest), MIN_SCALE), 1.0
    if smallest > MAX_SCALE_RATIO:
        return 1.0, max(1 / float(smallest), MIN_SCALE)
    return 1.0, 1.0
