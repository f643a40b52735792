"""Parallax: whether what lies off a plane moves along lines through an epipole, as depth does.

The second image is warped by the homography of the plane, and corners and tentative matches are
tracked to it. If the homography does not explain a place of a static scene, the place is displaced
along a line through the epipole (Chum, Werner and Matas, "Two-view geometry estimation unaffected
by a dominant plane", 2005). Lens distortion, wind and wrong tracks displace places in any
direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.homography_refinement import MAX_ROUND_TRIP_PX
from ...geometry.images import equalise, track_round_trip, warp_to_reference
from ...geometry.transforms import scaled_homography, scaled_points, transform_points
from .image_pair import ImagePair, Pair

SIDE_PX = 1024
"""Images are reduced to this longer side. Lengths below are in pixels of the reduced images."""

CORNERS, WINDOW_PX, CELL_PX = 1500, 15, 16
"""Maximum number of tracked corners, side of their windows, and of the squares from which one track
each is used."""

MAX_PARALLAX_PX = 60.0
"""Tentative matches farther from the plane than this are not tracked: the views are too unlike."""

NOISE_PX = 1.0
"""Tracks that miss the plane by less than this may be inexact. The error of tracks is a third."""

SAMPLES, MAX_ANGLE = 1000, 0.25
"""Epipoles that are tried, and angle in radians between a displacement and its line that still
agree: a third of the error of tracks for each pixel."""

MIN_ALIGNED, MIN_SHARE, MIN_FAR_SHARE = 0.8, 0.08, 0.02
"""A scene has depth if at least the first fraction of the places off the plane agrees with an
epipole, and the second fraction of all places is off the plane and agrees. Something stands before
the plane if the first fraction of what is off by more than `FAR` times the noise agrees, and the
third fraction of all places is so. By chance, 0.16 of the places agree."""

FAR = 3.0


@dataclass(frozen=True, eq=False)
class Parallax:
    """How the places off a plane move.

    Attributes:
        aligned: fraction of the places off the plane that agree with the best epipole.
        share: fraction of all places that are off the plane and agree with it.
        far_aligned, far_share: the same of the places that are clearly off the plane.
        points0, points1: (N, 2) places in both images, to a fraction of a pixel.
    """

    aligned: float
    share: float
    far_aligned: float
    far_share: float
    points0: np.ndarray
    points1: np.ndarray

    @property
    def shows_depth(self) -> bool:
        """Whether the scene has depth."""
        return self.aligned >= MIN_ALIGNED and self.share >= MIN_SHARE

    @property
    def shows_foreground(self) -> bool:
        """Whether something stands before the plane, or behind it, however small."""
        return self.far_aligned >= MIN_ALIGNED and self.far_share >= MIN_FAR_SHARE


def measure_parallax(
    pair: ImagePair, homography: np.ndarray, matches: Pair, seed: int = 0
) -> Parallax:
    """Track corners and matches, (M, 2) in both images, relative to the plane of a homography."""
    (first, second), (scale0, scale1) = pair.both(SIDE_PX)
    matrix = scaled_homography(homography, scale0, scale1)
    warped, valid = warp_to_reference(second, matrix, first.shape[::-1], exact=True)
    inside = cv2.erode(valid.astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX)), borderValue=0)
    equalised = equalise(first)
    corners = cv2.goodFeaturesToTrack(equalised, CORNERS, 0.001, 5, mask=inside)
    starts = np.empty((0, 2)) if corners is None else corners.reshape(-1, 2)
    back = np.linalg.inv(matrix)
    matched = scaled_points(matches[0], scale0)
    ends = transform_points(scaled_points(matches[1], scale1), back)
    near = np.linalg.norm(ends - matched, axis=1) < MAX_PARALLAX_PX
    starts, expected = (
        np.concatenate(both).astype(np.float32)
        for both in ((starts, matched[near]), (starts, ends[near]))
    )
    if not len(starts):
        return Parallax(0.0, 0.0, 0.0, 0.0, np.empty((0, 2)), np.empty((0, 2)))
    tracked, gaps = track_round_trip(
        equalised, equalise(warped), starts, WINDOW_PX, levels=1, expected=expected
    )
    good = gaps < MAX_ROUND_TRIP_PX
    starts, tracked = starts[good].astype(np.float64), tracked[good].astype(np.float64)
    _, one = np.unique((starts // CELL_PX).astype(int), axis=0, return_index=True)
    starts, tracked = starts[one], tracked[one]
    moved = tracked - starts
    length = np.linalg.norm(moved, axis=1)
    off = length > NOISE_PX
    points = scaled_points(starts, 1 / scale0), transform_points(tracked, matrix)
    points = points[0], scaled_points(points[1], 1 / scale1)
    if np.count_nonzero(off) < 3:
        return Parallax(0.0, 0.0, 0.0, 0.0, *points)
    agreeing = _agreeing(starts[off], moved[off] / length[off, None], max(first.shape), seed)
    far = length[off] > FAR * NOISE_PX
    clear, clearly_off = (int(np.count_nonzero(each)) for each in (agreeing & far, far))
    return Parallax(
        float(agreeing.mean()),
        float(agreeing.sum() / len(off)),
        clear / max(clearly_off, 1),
        clear / len(off),
        *points,
    )


def _agreeing(places: np.ndarray, directions: np.ndarray, side: int, seed: int) -> np.ndarray:
    """Return which of (N, 2) directions agree with the epipole with which most agree, (N,) bool."""
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
