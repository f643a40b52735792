"""Dense matches of a scene with depth, by rectification: epipolar lines become rows.

Corresponding rows are matched (`matching.stereo`) over a range of disparities that sparse matches
give. Each match ends at a sub-pixel position, not at a keypoint.

A fundamental matrix from few matches may be wrong by some pixels far from these matches. So corners
are tracked from one view to the other, starting from the matches of the rows, and the matrix is
fitted to the tracks. The images are rectified again if the new epipolar lines differ from the rows,
or if the disparities have so narrow a range that larger images can be searched.

The constants were chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip, unless noted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..._shared.opencv import cv2
from ...features.matches import GuidedMatches
from ...geometry.epipolar_rectification import PolarFrame, RectifiedFrame, rectified_frame
from ...geometry.images import (
    MAX_ROUND_TRIP_PX,
    downscale,
    equalise,
    gaussian_blur,
    local_zncc,
    track_round_trip,
)
from ...geometry.semi_calibrated import refine_fundamental
from ...geometry.transforms import (
    epipolar_errors,
    scaled_fundamental,
    scaled_homography,
    scaled_points,
)
from ..stereo.matching import (
    DisparityOptions,
    compute_disparity,
    range_with_margin,
)
from ..stereo.sgm import DisparityRange
from .image_pair import Pair

DISPARITY = DisparityOptions(discontinuity_margin_px=1)
"""Options for matching rows. The range of disparities is set for each pair."""

MAX_VOLUME = 2.5e7
"""Images are scaled down if pixels times disparities exceed this, to bound time and memory."""

MARGIN_PX, MARGIN_FRACTION = 4.0, 0.25
"""The range of disparities is extended at both ends by this many pixels plus this fraction of its
length. Chosen on Oxford and others."""

MIN_FRACTION_OF_ONE_SIGN = 0.8
"""If more than this fraction of the sparse matches in a polar frame has disparities of one sign,
the range extends only by `MARGIN_PX` into the other sign. Chosen on Oxford and others."""

CORRELATION_WINDOW_PX, CORRELATION_SIGMA_PX = 9, 1.0
"""Side of the windows in which rectified views are correlated, and sigma of the preceding blur."""

MIN_CORRELATION = 0.3
"""Geometry relies on a match if the correlation of its windows is at least this. With less, it is
kept if the correlation is above 0: chance gives as many below as above."""

MAX_ROW_ERROR_PX, ROW_QUANTILE = 0.5, 0.9
"""The images are rectified again if fewer than the second fraction of the tracked corners have
their rows within the first distance of the refined epipolar lines. Chosen on Oxford and others."""

MAX_RANGE_EXCESS = 1.25
"""Scaled-down images are also rectified again if the searched range was more than this many times
the range of the disparities found. Chosen on Oxford and others."""

TRACKED_CORNERS, TRACKED_WINDOW_PX = 2000, 15
"""Maximum number of tracked corners, and side of their windows. Chosen on Oxford and others."""

MAX_TRACK_PX = 4.0
"""Maximum distance of a track's end from the match on its row. Chosen on Oxford and others."""

MIN_TRACKS = 50
"""A pair with fewer tracked corners gets no dense matches. Chosen on Oxford and others."""

MAX_DISAGREEMENT_PX = 3.0
"""A sparse match agrees with the disparity at its start if its own differs by less than this. The
limit is loose, because sparse matches come from another scale. Chosen on Oxford and others."""

MIN_AGREEMENT = 0.6
"""This fraction or more of the sparse matches must agree with the disparities. On facades, a
quarter of the sparse matches end at the next window on the epipolar line."""


FINER, MIN_NEAR = 2.0, 8
"""If a wide range of disparities has made the images smaller than 1 / FINER of their size, what
lies near the plane is matched again in images this many times as large: an eighth of the range is
searched, so it takes as long. At least MIN_NEAR sparse matches must lie there."""


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """Two rectified images and the disparities between them.

    `views` are the images, scaled by `scale`, in the `frame`. `searched` is the range of
    disparities that was tried. `disparity` is NaN where no match is kept. `relied` marks matches
    that geometry may rely on. `correlation` is the local ZNCC of the first view with the second
    view at its disparity. All arrays are (H, W).
    """

    frame: RectifiedFrame
    scale: float
    views: Pair
    searched: DisparityRange
    disparity: np.ndarray
    relied: np.ndarray
    correlation: np.ndarray

    def to_frame(self, points: np.ndarray, side: int) -> np.ndarray:
        """Map points from an image of full size to the frame."""
        return self.frame.to_frame(scaled_points(points, self.scale), side)

    def from_frame(self, points: np.ndarray, side: int) -> np.ndarray:
        """Map points from the frame to an image of full size."""
        return scaled_points(self.frame.from_frame(points, side), 1 / self.scale)

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the indices of the points inside the frame, and their pixels' columns and rows."""
        height, width = self.disparity.shape
        nearest = np.rint(np.where(np.isfinite(points), points, -1)).astype(np.int64)
        inside = np.flatnonzero(((nearest >= 0) & (nearest < (width, height))).all(axis=1))
        return inside, *nearest[inside].T


def match_by_rectification(
    grays: Pair,
    xy0: np.ndarray,
    sparse: Pair,
    fundamental: np.ndarray,
    plane: np.ndarray | None = None,
) -> tuple[np.ndarray, GuidedMatches] | None:
    """Match (N, 2) keypoints of the first image by rectifying the pair.

    The `sparse` matches, (M, 2) in both images, agree with the fundamental matrix, x1^T F x0 = 0.
    If given, the homography of a `plane` of the scene warps the second view close to the first.
    Returns the refined matrix and the matches, which fit it exactly; None if too few corners can be
    tracked, the sparse matches contradict the disparities, or the pair cannot be rectified.
    """
    sizes = (grays[0].shape[::-1], grays[1].shape[::-1])
    view = rectified_view(grays, sparse, fundamental, plane)
    tracks = None if view is None else _track(view)
    if view is not None and tracks is None:
        view = _finer_view(grays, sparse, fundamental, plane, view)
        tracks = None if view is None else _track(view)
    if view is None or tracks is None:
        return None
    tracked, on_rows = tracks
    fundamental = refine_fundamental((sparse, tracked), fundamental, sizes)
    row_error = np.quantile(epipolar_errors(tracked[0], on_rows, fundamental), ROW_QUANTILE)
    if row_error > MAX_ROW_ERROR_PX or _is_range_too_wide(view):
        again = rectified_view(grays, tracked, fundamental, plane)
        tracks = None if again is None else _track(again)
        if again is not None and tracks is not None:
            counts = [np.count_nonzero(each.relied) for each in (view, again)]
            if counts[1] >= counts[0]:
                view, row_error = again, 0.0
                fundamental = refine_fundamental((sparse, tracks[0]), fundamental, sizes)
    if _agreement(view, sparse) < MIN_AGREEMENT:
        return None
    # If the rows still do not fit the matrix, only matches that geometry relies on are kept.
    near = row_error * view.scale < MAX_ROW_ERROR_PX
    samples = [_sample(view, xy0, relied_only=not near)]
    fine = _finer_view(grays, sparse, fundamental, plane, view)
    tracks = None if fine is None else _track(fine)
    if fine is not None and tracks is not None:
        fundamental = refine_fundamental((sparse, tracks[0]), fundamental, sizes)
        samples.insert(0, _sample(fine, xy0))
    rows, ends, scores = _first_of(samples)
    ends = _moved_to_lines(xy0[rows], ends, fundamental)
    inside = ((ends > -0.5) & (ends < np.array(sizes[1]) - 0.5)).all(axis=1)
    return fundamental, GuidedMatches(rows[inside], ends[inside], scores[inside], subpixel=True)


def _finer_view(
    grays: Pair,
    sparse: Pair,
    fundamental: np.ndarray,
    plane: np.ndarray | None,
    coarse: RectifiedView,
) -> RectifiedView | None:
    """Rectify larger images for what lies near a plane, if a wide range has made them small."""
    if plane is None or coarse.scale > 1 / FINER:
        return None
    first, second = (coarse.to_frame(points, side) for side, points in enumerate(sparse))
    limit = (coarse.searched[1] - coarse.searched[0]) / FINER**3 / 2
    near = np.abs(first[:, 0] - second[:, 0]) < limit
    if np.count_nonzero(near) < MIN_NEAR:
        return None
    return rectified_view(grays, (sparse[0][near], sparse[1][near]), fundamental, plane)


def rectified_view(
    grays: Pair,
    sparse: Pair,
    fundamental: np.ndarray,
    plane: np.ndarray | None = None,
    scale: float | None = None,
) -> RectifiedView | None:
    """Rectify both images, scaled down if there is too much to search, and match their rows.

    Only the function itself sets `scale`, when it calls itself with scaled-down images.
    """
    sizes = grays[0].shape[::-1], grays[1].shape[::-1]
    frame = rectified_frame(*sparse, fundamental, *sizes, plane)
    if frame is None:
        return None
    low, high = _range_of_matches(frame, sparse)
    volume = float(np.prod(frame.size)) * (high - low + 1)
    if scale is None and volume > MAX_VOLUME:
        longest = max(max(gray.shape) for gray in grays)
        scale = max(1, round(longest * (MAX_VOLUME / volume) ** (1 / 3))) / longest
        small0, small1 = (downscale(gray, round(max(gray.shape) * scale))[0] for gray in grays)
        points0, points1 = (scaled_points(points, scale) for points in sparse)
        fundamental = scaled_fundamental(fundamental, scale, scale)
        plane = None if plane is None else scaled_homography(plane, scale, scale)
        return rectified_view((small0, small1), (points0, points1), fundamental, plane, scale)
    (first, valid0), (second, valid1) = frame.warp(grays[0], 0), frame.warp(grays[1], 1)
    widest = frame.size[0] - 1
    searched = max(low, -widest), min(high, widest)
    if searched[0] >= searched[1]:
        return None
    disparity, matched, correlation = _match_rows((first, second), (valid0, valid1), searched)
    kept, relied = (matched & (correlation >= bound) for bound in (0, MIN_CORRELATION))
    disparity = np.where(kept, disparity, np.float32(np.nan))
    views = first, second
    return RectifiedView(frame, scale or 1.0, views, searched, disparity, relied, correlation)


def _match_rows(
    views: Pair, shown: Pair, searched: DisparityRange
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (H, W) disparities, where they are matched, and correlations (-1 if not matched)."""
    rows = compute_disparity(*views, replace(DISPARITY, disparity_range=searched))
    row, column = np.indices(rows.disparity.shape, dtype=np.float32)
    x = np.where(rows.matched, column - rows.disparity, -1).astype(np.float32)
    aligned = cv2.remap(views[1], x, row, cv2.INTER_LINEAR)
    inside = cv2.remap(shown[1].astype(np.uint8), x, row, cv2.INTER_NEAREST) > 0
    matched = rows.matched & shown[0] & inside
    correlation = local_zncc(
        gaussian_blur(views[0], CORRELATION_SIGMA_PX),
        gaussian_blur(aligned, CORRELATION_SIGMA_PX),
        np.ones(row.shape, bool),
        CORRELATION_WINDOW_PX,
    )
    correlation = np.where(matched, np.nan_to_num(correlation), np.float32(-1))
    return rows.disparity, matched, correlation


def _range_of_matches(frame: RectifiedFrame, sparse: Pair) -> DisparityRange:
    """Return the range of the disparities of sparse matches, with a margin at both ends."""
    disparity = frame.to_frame(sparse[0], 0)[:, 0] - frame.to_frame(sparse[1], 1)[:, 0]
    disparity = disparity[np.isfinite(disparity)]
    if not len(disparity):
        return 0, 0
    smallest, largest = range_with_margin(disparity, MARGIN_PX, MARGIN_FRACTION)
    if isinstance(frame, PolarFrame):
        if np.mean(disparity > 0) > MIN_FRACTION_OF_ONE_SIGN:
            smallest = max(smallest, -MARGIN_PX)
        if np.mean(disparity < 0) > MIN_FRACTION_OF_ONE_SIGN:
            largest = min(largest, MARGIN_PX)
    return int(np.floor(smallest)), int(np.ceil(largest))


def _is_range_too_wide(view: RectifiedView) -> bool:
    """Return whether images were scaled down for a range much wider than their matches need."""
    low, high = range_with_margin(view.disparity[view.relied], MARGIN_PX, MARGIN_FRACTION)
    searched = view.searched[1] - view.searched[0]
    return view.scale < 1 and searched > MAX_RANGE_EXCESS * (high - low)


def _track(view: RectifiedView) -> tuple[Pair, np.ndarray] | None:
    """Track corners to the second view, starting from the matches of the rows.

    Returns the corners in both images at full size, and the ends of their tracks moved to the rows
    where the tracks start, as row matching assumes; None with fewer than `MIN_TRACKS` tracks.
    """
    first, second = (equalise(gray) for gray in view.views)
    mask = view.relied.astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(first, TRACKED_CORNERS, 0.001, 5, mask=mask)
    if corners is None or len(corners) < MIN_TRACKS:
        return None
    start = corners.reshape(-1, 2)
    column, row = np.rint(start).astype(np.int64).T
    disparity = view.disparity[row, column]
    expected = start - np.column_stack([disparity, np.zeros(len(start))]).astype(np.float32)
    ends, gaps = track_round_trip(
        first, second, start, TRACKED_WINDOW_PX, levels=1, expected=expected
    )
    good = gaps < MAX_ROUND_TRIP_PX
    good &= np.abs(ends - expected).max(axis=1) < MAX_TRACK_PX
    if np.count_nonzero(good) < MIN_TRACKS:
        return None
    start, ends = start[good], ends[good]
    on_rows = np.column_stack([ends[:, 0], start[:, 1]])
    return (view.from_frame(start, 0), view.from_frame(ends, 1)), view.from_frame(on_rows, 1)


def _agreement(view: RectifiedView, sparse: Pair) -> float:
    """Return the fraction of sparse matches that agree with the disparity where they start.

    Matches that start where geometry relies on no disparity are left out. If most of the others
    disagree, rows were matched to similar but wrong places.
    """
    positions = [view.to_frame(points, side) for side, points in enumerate(sparse)]
    inside, column, row = view.pixels_of(positions[0])
    errors = positions[0][inside, 0] - positions[1][inside, 0] - view.disparity[row, column]
    errors = np.abs(errors[view.relied[row, column] & np.isfinite(errors)])
    return float((errors < MAX_DISAGREEMENT_PX).mean()) if len(errors) else 0.0


def _moved_to_lines(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Move the second positions of matches to the nearest points on their epipolar lines."""
    lines = np.column_stack([points0, np.ones(len(points0))]) @ fundamental.T
    normal = lines[:, :2]
    distance = (normal * points1).sum(axis=1) + lines[:, 2]
    squared = np.maximum((normal**2).sum(axis=1), 1e-300)
    return np.asarray(points1 - normal * (distance / squared)[:, None])


def _first_of(
    samples: list[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join samples of several views; of a keypoint in several, the first counts."""
    rows, ends, scores = map(np.concatenate, zip(*samples, strict=True))
    rows, one = np.unique(rows, return_index=True)
    return rows, ends[one], scores[one]


def _sample(
    view: RectifiedView, xy0: np.ndarray, *, relied_only: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices of keypoints that have a disparity, their partners and their scores.

    With `relied_only`, only those that geometry relies on.
    """
    disparity = np.where(view.relied, view.disparity, np.nan) if relied_only else view.disparity
    height, width = disparity.shape
    positions = view.to_frame(xy0, 0)
    rows, column, row = view.pixels_of(positions)
    known = np.isfinite(disparity[row, column])
    rows, column, row = rows[known], column[known], row[known]
    positions, nearest = positions[rows], disparity[row, column]
    # The disparity is interpolated bilinearly over the neighbours on the same surface.
    left, top = np.floor(positions).astype(np.int64).T
    total, weights = np.zeros(len(rows)), np.full(len(rows), 1e-9)
    for down in (0, 1):
        for across in (0, 1):
            x, y = np.clip(left + across, 0, width - 1), np.clip(top + down, 0, height - 1)
            value = disparity[y, x]
            weight = np.abs(1 - across - (positions[:, 0] - left)) * np.abs(
                1 - down - (positions[:, 1] - top)
            )
            weight *= np.abs(value - nearest) <= 1  # False for NaN
            total += weight * np.nan_to_num(value - nearest)
            weights += weight
    shift = np.column_stack([nearest + total / weights, np.zeros(len(rows))])
    scores = np.clip(view.correlation[row, column], 0, 1)
    return rows, view.from_frame(positions - shift, 1), scores
