"""Dense matches of a scene with depth, by rectification: epipolar lines become rows.

Both images are warped into a frame in which matches lie on the same row
(`geometry.epipolar_rectification`), the row matcher finds a disparity for each pixel
(`matching.stereo`), and its matches are taken back to the images. They are sub-pixel
positions, not keypoints of the second image.

A fundamental matrix from few matches may miss by some pixels where none of them was. So corners are
tracked in both directions around their matches, and the matrix is fitted to them: matches are moved
to its lines, and where these are far from the rows, or larger images can be searched in the range
of what has been found, the images are rectified again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._shared.opencv import cv2
from ...features.matches import GuidedMatches
from ...geometry.images import equalise, track_round_trip
from ...geometry.semi_calibrated import refine_fundamental
from ...geometry.transforms import epipolar_errors, scaled_points
from .rectified_view import RectifiedView, range_with_margin, rectified_view

MAX_ROW_ERROR_PX, ROW_QUANTILE = 0.5, 0.9
"""Where this fraction of the tracked corners has its rows nearer than this to the lines of the new
matrix, the old rows are good enough, and the images are not rectified again."""

MAX_RANGE_EXCESS = 1.25
"""Images that were scaled down are rectified again, too, where more was searched than this times
the range of what was found."""

MIN_SIGMA_PX = 0.1
"""A track or a sparse match is never counted as more exact than this."""

TRACKED_CORNERS = 2000
TRACKED_WINDOW_PX = 15
"""Side of the windows in which they are tracked."""

MAX_ROUND_TRIP_PX = 0.3
"""A track counts when it ends this near to its start, forth and back."""

MAX_TRACK_PX = 4.0
"""A track that moves further than this from its match is wrong."""

MIN_TRACKS = 50
"""That a matrix is estimated from; where fewer corners can be tracked to where they are matched, no
match counts."""

MAX_DISAGREEMENT_PX = 3.0
"""By which the disparity of a right sparse match, found in images of another scale, may differ."""

MIN_AGREEMENT = 0.75
"""This fraction of the sparse matches must lie where the disparities say."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Corners that were tracked around their matches.

    Attributes:
        positions: (N, 2) in both images at their own size.
        on_rows: the same, moved in the frame to the rows of the first: where row matching may
            look for them.
    """

    positions: tuple[np.ndarray, np.ndarray]
    on_rows: tuple[np.ndarray, np.ndarray]


def match_by_rectification(
    gray0: np.ndarray,
    gray1: np.ndarray,
    xy0: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    fundamental: np.ndarray,
    exact: bool = False,
) -> tuple[np.ndarray, GuidedMatches] | None:
    """Match keypoints of the first image by rectifying the pair.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        xy0: (N, 2) keypoints of the first image.
        points0, points1: (K, 2) sparse matches that fit the fundamental matrix.
        fundamental: (3, 3) with x1^T F x0 = 0.
        exact: whether the matrix is known: the images are not rectified again by a better one, and
            sparse matches that contradict do not matter.

    Returns:
        The refined fundamental matrix and the matches, which fit it exactly; None where the pair
        cannot be rectified, too few corners can be tracked from one image to where they are
        matched, or the sparse matches contradict.
    """
    sizes = (gray0.shape[::-1], gray1.shape[::-1])
    sparse = points0, points1
    view = rectified_view(gray0, gray1, *sparse, fundamental)
    tracks = None if view is None else _track(view)
    if view is None or tracks is None:
        return None
    fundamental = _refine(fundamental, sparse, tracks, sizes)
    near = _are_near(tracks, fundamental)
    wide = _is_range_too_wide(view)
    if (wide or not near) and not exact:
        again = rectified_view(gray0, gray1, *tracks.positions, fundamental)
        found = None if again is None else _track(again)
        if again is not None and found is not None and _matched(again) >= _matched(view):
            view, tracks, near = again, found, True
            fundamental = _refine(fundamental, sparse, tracks, sizes)
    if not exact and _agreement(view, sparse) < MIN_AGREEMENT:
        return None
    # Rows that are off, and could not be corrected, are a reason to doubt low correlation.
    disparity = view.kept if near else view.disparities.disparity
    rows, places, scores = _sample(view, disparity, xy0)
    places = _moved_to_lines(xy0[rows], places, fundamental)
    height, width = gray1.shape
    inside = ((places > -0.5) & (places < (width - 0.5, height - 0.5))).all(axis=1)
    return fundamental, GuidedMatches(rows[inside], places[inside], scores[inside], subpixel=True)


def _refine(
    fundamental: np.ndarray,
    sparse: tuple[np.ndarray, np.ndarray],
    tracks: Tracks,
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> np.ndarray:
    """Fit the fundamental matrix to tracks and sparse matches, as exact as each of them are."""
    sigmas = []
    for points0, points1 in (sparse, tracks.positions):
        errors = epipolar_errors(points0, points1, fundamental)
        sigma = max(1.4826 * float(np.median(errors)), MIN_SIGMA_PX)
        sigmas.append(np.full(len(points0), sigma))
    points0, points1 = (np.concatenate([sparse[side], tracks.positions[side]]) for side in (0, 1))
    return refine_fundamental(points0, points1, fundamental, sizes, np.concatenate(sigmas))


def _agreement(view: RectifiedView, sparse: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the fraction of the sparse matches with a disparity that lie where it says.

    They know nothing of each other: where most contradict, what looks alike on the rows is another
    of many like things.
    """
    places = [
        view.frame.to_frame(scaled_points(points, view.scale), side)
        for side, points in enumerate(sparse)
    ]
    disparity = view.disparities.disparity
    height, width = disparity.shape
    nearest = np.rint(np.where(np.isfinite(places[0]), places[0], -1)).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(axis=1)
    column, row = nearest[inside].T
    errors = places[0][inside, 0] - places[1][inside, 0] - disparity[row, column]
    errors = np.abs(errors[np.isfinite(errors)])
    return float((errors < MAX_DISAGREEMENT_PX).mean()) if len(errors) else 0.0


def _are_near(tracks: Tracks, fundamental: np.ndarray) -> bool:
    """Whether the rows that were matched are near the lines of a matrix."""
    errors = epipolar_errors(*tracks.on_rows, fundamental)
    return float(np.quantile(errors, ROW_QUANTILE)) < MAX_ROW_ERROR_PX


def _is_range_too_wide(view: RectifiedView) -> bool:
    """Whether less had to be searched than was, so that larger images could have been matched."""
    searched = view.disparities.disparity_range
    if view.scale == 1 or searched is None:
        return False
    low, high = range_with_margin(view.disparities.disparity[view.disparities.matched])
    width = searched[1] - searched[0]
    return width > MAX_RANGE_EXCESS * (high - low)


def _moved_to_lines(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Move the second positions of matches to the nearest points of their epipolar lines."""
    lines = np.column_stack([points0, np.ones(len(points0))]) @ fundamental.T
    normal = lines[:, :2]
    distance = (normal * points1).sum(axis=1) + lines[:, 2]
    squared = np.maximum((normal**2).sum(axis=1), 1e-300)
    return np.asarray(points1 - normal * (distance / squared)[:, None])


def _matched(view: RectifiedView) -> int:
    return int(np.count_nonzero(view.disparities.matched))


def _track(view: RectifiedView) -> Tracks | None:
    """Track corners around their matches; None with fewer than `MIN_TRACKS`."""
    first, second = equalise(view.first), equalise(view.second)
    mask = view.disparities.matched.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(first, TRACKED_CORNERS, 0.001, 5, mask=mask)
    if corners is None or len(corners) < MIN_TRACKS:
        return None
    start = corners.reshape(-1, 2)
    column, row = np.rint(start).astype(np.int64).T
    expected = start - np.column_stack(
        [view.disparities.disparity[row, column], np.zeros(len(start))]
    ).astype(np.float32)
    there, gaps = track_round_trip(
        first, second, start, TRACKED_WINDOW_PX, levels=1, expected=expected
    )
    good = gaps < MAX_ROUND_TRIP_PX
    good &= np.abs(there - expected).max(axis=1) < MAX_TRACK_PX
    if np.count_nonzero(good) < MIN_TRACKS:
        return None
    on_rows = np.column_stack([there[good, 0], start[good, 1]])
    first_places, second_places, row_places = (
        scaled_points(view.frame.from_frame(points, side), 1 / view.scale)
        for points, side in ((start[good], 0), (there[good], 1), (on_rows, 1))
    )
    return Tracks((first_places, second_places), (first_places, row_places))


def _sample(
    view: RectifiedView, disparity: np.ndarray, xy0: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of the keypoints that have a disparity, their places and scores."""
    height, width = disparity.shape
    places = view.frame.to_frame(scaled_points(xy0, view.scale), 0)
    nearest = np.rint(np.where(np.isfinite(places), places, -1)).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(axis=1)
    rows = np.flatnonzero(inside)
    column, row = nearest[rows].T
    known = np.isfinite(disparity[row, column])
    rows, column, row = rows[known], column[known], row[known]
    places, own = places[rows], disparity[row, column]
    scores = view.correlation[row, column]
    # Bilinear, of the neighbours on the same surface.
    left, top = np.floor(places).astype(np.int64).T
    total, weights = np.zeros(len(rows)), np.full(len(rows), 1e-9)
    for down in (0, 1):
        for across in (0, 1):
            x, y = np.clip(left + across, 0, width - 1), np.clip(top + down, 0, height - 1)
            value = disparity[y, x]
            weight = np.abs(1 - across - (places[:, 0] - left)) * np.abs(
                1 - down - (places[:, 1] - top)
            )
            weight *= np.abs(value - own) <= 1  # not for NaN
            total += weight * np.nan_to_num(value - own)
            weights += weight
    shift = np.column_stack([own + total / weights, np.zeros(len(rows))])
    there = scaled_points(view.frame.from_frame(places - shift, 1), 1 / view.scale)
    return rows, there, np.clip(scores, 0, 1)
