"""Refine the homography of a plane by tracks, find parallax off the plane, and match along it.

The second image is warped by the homography of a plane. Corners and tentative matches are tracked
from the first image to the warped one. A homography is fitted to the largest set of tracks on one
plane. It is kept if, in squares of four alternating colours, homographies fitted to three colours
have no larger errors in the fourth colour than the initial homography.

In a static scene, parallax displaces points off the plane along lines through the epipole (Chum,
Werner and Matas, "Two-view geometry estimation unaffected by a dominant plane", 2005). Lens
distortion, wind and wrong tracks displace points in any direction.
"""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2
from ...features.keypoints import nearest_keypoints
from ...features.matches import GuidedMatches
from ...geometry.alignment import Alignment, align_patches
from ...geometry.estimation import GeometryOptions, estimate_geometry
from ...geometry.images import (
    MAX_ROUND_TRIP_PX,
    equalise,
    gaussian_blur,
    track_round_trip,
    warp_to_reference,
)
from ...geometry.transforms import scaled_homography, scaled_points, transform_points
from .image_pair import ImagePair, Pair
from .judge import Evidence, Judge

SIDE_PX, MAX_SCALE_RATIO, MIN_SCALE = 1024, 1.5, 1 / 16
"""Images are reduced to a longer side of SIDE_PX. An image that shows the plane over
MAX_SCALE_RATIO times larger is reduced to the other's scale, but not below MIN_SCALE of its size,
because corners of different scales lie at different places. Lengths are in pixels of the reduced
images."""

CORNERS, WINDOW_PX, CELL_PX = 1500, 21, 16
"""Maximum number of tracked corners, side of the windows that are tracked around them, and side of
the squares that each give one track to measure parallax. Chosen by hand."""

MIN_TRACKS, SQUARES = 15, 8
"""A geometry is fitted to at least MIN_TRACKS tracks. To validate a homography, the image is
divided into squares, SQUARES along its longer side, of four colours. Chosen by hand."""

MAX_PARALLAX = 0.15
"""A tentative match is not tracked if its second point is farther than this fraction of the longer
side from where the homography maps its first: the views differ too much there. If a post before a
wall covers 7 % of synthetic views, 0.1 leaves too few tracks on it to show that it is nearer."""

ALIGNMENT, BLUR_PX = Alignment(radius_px=7, max_shift_px=2.0, convergence_px=0.02, cubic=False), 0.8
"""Tracks are refined by aligning a patch of the first image, after a blur of both. On planes of
synthetic pairs, this halves the error of homographies. Patches are as in `refine_matches`."""

NOISE_PX = 1.0
"""A track is on the plane if it ends nearer than this, three times its error, to its prediction."""

MAX_DISTANCE_PX = 1.0
"""A homography matches two keypoints if it maps the first to within this many full-size pixels of
the second. Both lie on whole pixels, and rounding alone displaces each by up to 0.7 px."""

SAMPLES, MAX_ANGLE = 1000, 0.25
"""SAMPLES epipoles are tried. A displacement agrees with one if its direction is within MAX_ANGLE
radians of the line to it: the error of a track turns a displacement of 1 px by about as much."""

MIN_ALIGNED, MIN_SHARE, MIN_FAR_SHARE = 0.8, 0.08, 0.02
"""A scene has depth if at least MIN_ALIGNED of the tracks off the plane agree with one epipole, and
these are MIN_SHARE or more of all tracks. An object stands before the plane if MIN_ALIGNED of the
tracks off it by FAR * NOISE_PX or more agree, and these are MIN_FAR_SHARE of all tracks. A random
direction agrees with a given epipole with a probability of 0.16. Limits are chosen by hand."""

SURE_SHARE = 0.28
"""A scene also has depth if this share of all tracks is off the plane and agrees with one epipole.
Planes of Oxford have at most 0.23, Strecha's entry 1-3 has 0.32, Middlebury's cloth has 0.42."""

FAR = 3.0


NOTHING: Pair = np.empty((0, 2)), np.empty((0, 2))


class PlaneTracks:
    """Corners and matches, (M, 2) in both images, tracked relative to the plane of a homography.

    Corners are tracked only where `free`, (rows, columns) bool over the image, is true.

    Attributes:
        homography: (3, 3), fitted to the tracks if the fit is validated, otherwise as given.
        points: (N, 2) in each image, where the tracks start and end.
    """

    def __init__(
        self,
        pair: ImagePair,
        homography: np.ndarray,
        matches: Pair = NOTHING,
        free: np.ndarray | None = None,
    ) -> None:
        scales = _scales_at_centre(homography, pair.sizes[0])
        (first, scale0), (second, scale1) = (
            pair.reduced(side, min(SIDE_PX, round(max(size) * scale)))
            for side, (size, scale) in enumerate(zip(pair.sizes, scales, strict=True))
        )
        self._side = max(first.shape)
        matrix = self._matrix = scaled_homography(homography, scale0, scale1)
        ends = scaled_points(matches[0], scale0), scaled_points(matches[1], scale1)
        self._starts, self._ends, aligned = _tracked((first, second), matrix, ends, free)
        exact = self._starts[aligned], self._ends[aligned]
        moved = transform_points(self._ends, matrix)
        self.points = scaled_points(self._starts, 1 / scale0), scaled_points(moved, 1 / scale1)
        self.homography = homography
        correction = _fitted(*exact, NOISE_PX)
        if correction is not None and _validated(*exact, self._side / SQUARES):
            refined = scaled_homography(matrix @ correction, 1 / scale0, 1 / scale1)
            self.homography = refined / refined[2, 2]
        # Parallax is measured from the plane on which most tracks lie within NOISE_PX / 2.
        sharp = _fitted(*exact, NOISE_PX / 2)
        if sharp is not None:
            self._ends = transform_points(self._ends, np.linalg.inv(sharp))

    def show_depth(self, foreground: bool = False, seed: int = 0) -> bool:
        """Return whether the scene has depth or, if `foreground`, an object far from its plane."""
        _, one = np.unique((self._starts // CELL_PX).astype(int), axis=0, return_index=True)
        places, moved = self._starts[one], (self._ends - self._starts)[one]
        length = np.linalg.norm(moved, axis=1)
        # A motion below one pixel of the second image, which may be foreshortened, is also noise.
        seen = transform_points(self._ends[one], self._matrix)
        seen -= transform_points(places, self._matrix)
        length = np.minimum(length, np.linalg.norm(seen, axis=1))
        off, count = length > NOISE_PX, len(length)
        if np.count_nonzero(off) < 3:
            return False
        agreeing = _agreeing(places[off], moved[off], self._side, seed)
        if agreeing.sum() >= SURE_SHARE * count:
            return True
        far = length[off] > FAR * NOISE_PX
        kinds = [(agreeing, MIN_SHARE), *([(agreeing[far], MIN_FAR_SHARE)] if foreground else [])]
        return any(
            kind.sum() >= max(MIN_ALIGNED * len(kind), least * count) for kind, least in kinds
        )


def match_along_plane(
    pair: ImagePair, pixels: Pair, homography: np.ndarray, judge: Judge, evidence: Evidence
) -> GuidedMatches:
    """Match keypoints, (N, 2) and (M, 2) whole pixels, where the images agree with a homography."""
    predicted = transform_points(pixels[0], homography)
    indices1, distances = nearest_keypoints(predicted, pixels[1], pair.sizes[1])
    indices0 = np.flatnonzero(distances < MAX_DISTANCE_PX)
    cells = judge.cells_of(pixels[0][indices0])
    kept = evidence.believed[cells]
    indices0 = indices0[kept]
    indices1 = indices1[indices0]
    scores = np.nan_to_num(evidence.similarity[cells][kept], nan=evidence.bound).astype(np.float32)
    ends = pixels[1][indices1].astype(np.float64)
    return GuidedMatches(indices0, ends, scores.clip(0, 1), indices1=indices1)


def _validated(starts: np.ndarray, ends: np.ndarray, side_px: float) -> bool:
    """Return whether fits to the squares of three of four colours hold in the fourth's."""
    colours = (starts // side_px).astype(np.int64) % 2 @ [1, 2]
    predicted = np.empty_like(starts)
    for own in (colours == colour for colour in range(4)):
        found = _fitted(starts[~own], ends[~own], NOISE_PX)
        if found is None:
            return False
        predicted[own] = transform_points(starts[own], found)
    return _misfit(predicted, ends) <= _misfit(starts, ends)


def _misfit(expected: np.ndarray, ends: np.ndarray) -> float:
    """Return the mean squared error of (N, 2) tracks, after errors are limited to `NOISE_PX`."""
    return float(np.minimum(((ends - expected) ** 2).sum(axis=1), NOISE_PX**2).mean())


def _fitted(starts: np.ndarray, ends: np.ndarray, threshold_px: float) -> np.ndarray | None:
    """Return the homography of the plane with most tracks; None below `MIN_TRACKS` tracks."""
    if len(starts) < MIN_TRACKS:
        return None
    options = GeometryOptions(inlier_threshold=threshold_px)
    found = estimate_geometry(starts, ends, "homography", options=options).matrix
    if found is None:
        return None
    near = np.linalg.norm(ends - transform_points(starts, found), axis=1) < NOISE_PX / 2
    return cv2.findHomography(starts[near], ends[near])[0] if near.sum() >= MIN_TRACKS else None


def _tracked(
    views: Pair, matrix: np.ndarray, matches: Pair, free: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Track corners and matches.

    Returns (N, 2) starts and ends in the frame of the first image, and which ends were refined by
    an alignment, (N,) bool.
    """
    first, second = views
    warped, valid = warp_to_reference(second, matrix, first.shape[::-1], exact=True)
    inside = cv2.erode(valid.astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX)), borderValue=0)
    if free is not None:
        size = inside.shape[::-1]
        inside &= cv2.resize(free.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    equalised = equalise(first)
    corners = cv2.goodFeaturesToTrack(equalised, CORNERS, 0.001, 5, mask=inside)
    starts = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2)
    ends = transform_points(matches[1], np.linalg.inv(matrix))
    near = np.linalg.norm(ends - matches[0], axis=1) < MAX_PARALLAX * max(first.shape)
    starts, expected = (
        np.concatenate(both).astype(np.float32)
        for both in ((starts, matches[0][near]), (starts, ends[near]))
    )
    if not len(starts):
        return np.empty((0, 2)), np.empty((0, 2)), np.empty(0, bool)
    tracked, gaps = track_round_trip(
        equalised, equalise(warped), starts, WINDOW_PX, levels=1, expected=expected
    )
    good = gaps < MAX_ROUND_TRIP_PX
    starts, tracked = starts[good], tracked[good]
    soft0, soft1 = (gaussian_blur(gray.astype(np.float32), BLUR_PX) for gray in (first, warped))
    unit = np.tile(np.eye(2), (len(starts), 1, 1))
    aligned = align_patches((soft0, soft1), starts, tracked, unit, ALIGNMENT)
    return starts.astype(np.float64), aligned.points1, aligned.converged


def _scales_at_centre(homography: np.ndarray, size: tuple[int, int]) -> tuple[float, float]:
    """Return the factors by which to scale the images so that both show equally fine detail."""
    centre = np.array([size[0] / 2, size[1] / 2])
    around = transform_points(centre + [[0, 0], [1, 0], [0, 1]], homography)
    if not np.isfinite(around).all():
        return 1.0, 1.0
    largest, smallest = np.linalg.svd(around[1:] - around[0], compute_uv=False)
    if largest * MAX_SCALE_RATIO < 1:
        return max(float(largest), MIN_SCALE), 1.0
    if smallest > MAX_SCALE_RATIO:
        return 1.0, max(1 / float(smallest), MIN_SCALE)
    return 1.0, 1.0


def _agreeing(places: np.ndarray, moved: np.ndarray, side: int, seed: int) -> np.ndarray:
    """Find the epipole with which most of (N, 2) motions agree; return which agree, (N,) bool."""
    directions = moved / np.linalg.norm(moved, axis=1)[:, None]
    places = np.column_stack([places / side - 0.5, np.ones(len(places))])
    lines = np.cross(places, np.column_stack([directions, np.zeros(len(directions))]))
    chosen = np.random.default_rng(seed).integers(0, len(lines), (SAMPLES, 2))
    epipoles = np.cross(lines[chosen[:, 0]], lines[chosen[:, 1]])
    length = np.linalg.norm(epipoles, axis=1)
    epipoles = epipoles[length > 1e-3] / length[length > 1e-3, None]
    if not len(epipoles):
        return np.zeros(len(places), bool)
    towards = epipoles[:, None, :2] - epipoles[:, None, 2:] * places[None, :, :2]
    towards /= np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    across = np.abs(towards[..., 0] * directions[:, 1] - towards[..., 1] * directions[:, 0])
    agreeing = across < MAX_ANGLE
    return np.asarray(agreeing[np.argmax(np.count_nonzero(agreeing, axis=1))])
