"""Dense matches of a scene with depth, by rectification: epipolar lines become rows.

Corresponding rows are matched (`matching.stereo`) over the range of disparities of sparse matches.
Each match ends at a sub-pixel position, not at a keypoint.

A fundamental matrix from few matches may be wrong by some pixels far from these matches. So it is
fitted also to corners, which are tracked from where the disparities predict them.

The constants were chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip, unless noted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..._shared.opencv import cv2
from ...features.matches import GuidedMatches
from ...geometry.epipolar_rectification import RectifiedFrame, rectified_frame
from ...geometry.images import (
    MAX_ROUND_TRIP_PX,
    downscale,
    equalise,
    gaussian_blur,
    local_zncc,
    track_round_trip,
)
from ...geometry.refinement import refine_fundamental
from ...geometry.transforms import (
    scaled_fundamental,
    scaled_homography,
    scaled_points,
    transfer_errors,
)
from ..stereo.matching import (
    DisparityOptions,
    compute_disparity,
    range_with_margin,
)
from ..stereo.sgm import MAX_DIFFERENCE_PX, DisparityRange, refine_disparity
from .along_plane import CORNERS, MAX_PARALLAX, MIN_TRACKS, WINDOW_PX
from .image_pair import Pair

DISPARITY = DisparityOptions(discontinuity_margin_px=1)
"""Options for matching rectified rows. Sparse matches set the range of disparities of a pair."""

MAX_PIXELS, MAX_VOLUME = 1e6, 1.2e7
"""Rectified images have at most MAX_PIXELS pixels. If pixels times disparities exceed MAX_VOLUME,
disparities are searched in reduced copies, to bound time and memory. They are then refined in the
rectified images themselves."""

MAX_STEP_PX = 4.0
"""If the search steps are coarser than this, a second search covers only the disparities near the
plane of a known homography, in finer steps. The result with more matches is kept."""

MARGIN_PX, MARGIN_FRACTION = 4.0, 0.25
"""The range of disparities is extended at both ends by MARGIN_PX plus MARGIN_FRACTION of its
length. Chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip."""

CORRELATION_WINDOW_PX, CORRELATION_SIGMA_PX = 9, 1.0
"""Side of the windows in which rectified views are correlated, and sigma of their blur before."""

MAX_DISAGREEMENT_PX = 3.0
"""A sparse match agrees with the disparity map if their disparities differ by less than this number
of search steps (pixels). The limit is loose, because sparse matches come from another scale.
Chosen on Oxford, Middlebury, Strecha's fountain and a KITTI clip."""

MIN_AGREEMENT = 0.6
"""This fraction of the sparse matches or more must agree with the disparity map. It is not higher,
since on a facade of equal windows a quarter of them end one window off on their epipolar line."""


@dataclass(frozen=True, eq=False)
class RectifiedView:
    """Two rectified images and the disparities between them.

    `views` are the images, scaled by `scale`, in the `frame`. `step_px` is the step with which
    disparities were searched. `disparity` is NaN where nothing is matched. `correlation` is the
    local ZNCC of the first view with the second view at its disparity. All arrays are (H, W).
    """

    frame: RectifiedFrame
    scale: float
    step_px: float
    views: Pair
    disparity: np.ndarray
    correlation: np.ndarray

    def to_frame(self, points: np.ndarray, side: int) -> np.ndarray:
        """Map (N, 2) points of full-size image number `side` (0, 1) to its rectified view."""
        return self.frame.to_frame(scaled_points(points, self.scale), side)

    def from_frame(self, points: np.ndarray, side: int) -> np.ndarray:
        """Map (N, 2) points of rectified view number `side` (0, 1) to its full-size image."""
        return scaled_points(self.frame.from_frame(points, side), 1 / self.scale)

    def pixels_of(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the indices of points inside the view, and their pixels' columns and rows."""
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
    found = _best_view(grays, sparse, fundamental, plane)
    if found is None:
        return None
    view, tracked = found
    fundamental = refine_fundamental((sparse, tracked), fundamental, sizes)
    if _agreement(view, sparse) < MIN_AGREEMENT:
        return None
    rows, ends, scores = _sample(view, xy0)
    ends = _moved_to_lines(xy0[rows], ends, fundamental)
    inside = ((ends > -0.5) & (ends < np.array(sizes[1]) - 0.5)).all(axis=1)
    return fundamental, GuidedMatches(rows[inside], ends[inside], scores[inside], subpixel=True)


def _best_view(
    grays: Pair, sparse: Pair, fundamental: np.ndarray, plane: np.ndarray | None
) -> tuple[RectifiedView, Pair] | None:
    """Match rows, over all disparities or near a plane; return the denser result and its tracks."""
    ways, best, most = [sparse], None, 0.0
    if plane is not None:
        reach_px = MAX_PARALLAX * max(grays[0].shape)
        near = transfer_errors(*sparse, plane) < reach_px
        ways.append((sparse[0][near], sparse[1][near]))
    for points in ways:
        view = rectified_view(grays, points, fundamental, plane)
        tracks = None if view is None else _track(view)
        if view is None or tracks is None:
            continue
        matched = np.count_nonzero(np.isfinite(view.disparity)) / view.scale**2
        if matched > most:
            best, most = (view, tracks), matched
        if view.step_px <= MAX_STEP_PX:
            break
    return best


def rectified_view(
    grays: Pair, sparse: Pair, fundamental: np.ndarray, plane: np.ndarray | None = None
) -> RectifiedView | None:
    """Rectify both images and match their rows; None if that fails or the views do not overlap."""
    ways = [None] if plane is None else [plane, None]
    frames = [(_frame(grays, sparse, fundamental, way, 1.0), way) for way in ways]
    volumes = [np.inf if each is None else _volume(each, sparse) for each, _ in frames]
    frame, plane = frames[int(np.argmin(volumes))]
    if frame is None:
        return None
    scale, pixels = 1.0, float(np.prod(frame.size))
    if pixels > MAX_PIXELS:
        longest = max(max(gray.shape) for gray in grays)
        scale = max(1, round(longest * (MAX_PIXELS / pixels) ** 0.5)) / longest
        first, second = (downscale(gray, round(max(gray.shape) * scale))[0] for gray in grays)
        grays = first, second
        frame = _frame(grays, sparse, fundamental, plane, scale)
        if frame is None:
            return None
    starts, ends = (scaled_points(points, scale) for points in sparse)
    searched = _range_of_matches(frame, (starts, ends))
    if searched[0] >= searched[1]:  # the rectified views do not overlap
        return None
    (first, shown0), (second, shown1) = frame.warp(grays[0], 0), frame.warp(grays[1], 1)
    disparity, matched, step_px = _match_rows((first, second), searched)
    correlation = _correlation((first, second), (shown0, shown1), disparity, matched)
    # Wrong matches correlate below 0 as often as above it, so all matches below 0 are dropped.
    disparity = np.where(matched & (correlation >= 0), disparity, np.float32(np.nan))
    return RectifiedView(frame, scale, step_px, (first, second), disparity, correlation)


def _volume(frame: RectifiedFrame, sparse: Pair) -> float:
    """Return the number of pixels times the number of disparities to search."""
    low, high = _range_of_matches(frame, sparse)
    return float(np.prod(frame.size)) * (high - low + 1) if high > low else np.inf


def _frame(
    grays: Pair, sparse: Pair, fundamental: np.ndarray, plane: np.ndarray | None, scale: float
) -> RectifiedFrame | None:
    """Return the rectification of reduced images, `grays`, from geometry at full size."""
    points0, points1 = (scaled_points(points, scale) for points in sparse)
    fundamental = scaled_fundamental(fundamental, scale, scale)
    plane = None if plane is None else scaled_homography(plane, scale, scale)
    sizes = grays[0].shape[::-1], grays[1].shape[::-1]
    return rectified_frame(points0, points1, fundamental, *sizes, plane)


def _match_rows(views: Pair, searched: DisparityRange) -> tuple[np.ndarray, np.ndarray, float]:
    """Return (H, W) disparities, the mask of matched pixels, and the step of the search in pixels.

    Disparities are searched in small copies of the views, and refined in the views themselves.
    """
    height, width = views[0].shape
    volume = height * width * (searched[1] - searched[0] + 1)
    factor = min(1.0, (MAX_VOLUME / volume) ** (1 / 3))
    size = max(round(width * factor), 2), max(round(height * factor), 2)
    factor = size[0] / width
    left, right = (cv2.resize(view, size, interpolation=cv2.INTER_AREA) for view in views)
    widest = size[0] - 1
    low, high = math.floor(searched[0] * factor), math.ceil(searched[1] * factor)
    low, high = max(low, -widest), min(high, widest)
    rows = compute_disparity(left, right, replace(DISPARITY, disparity_range=(low, high)))
    if size == (width, height):
        return rows.disparity, rows.matched, 1.0
    known = np.where(rows.matched, rows.disparity, np.float32(np.nan)) / factor
    nearest, linear = (
        cv2.resize(known, (width, height), interpolation=how)
        for how in (cv2.INTER_NEAREST_EXACT, cv2.INTER_LINEAR)
    )
    with np.errstate(invalid="ignore"):
        one_surface = np.abs(linear - nearest) < MAX_DIFFERENCE_PX / factor
    start = np.where(one_surface, linear, nearest)
    matched = np.isfinite(start)
    return refine_disparity(*views, np.where(matched, start, 0), matched), matched, 1 / factor


def _correlation(
    views: Pair, shown: Pair, disparity: np.ndarray, matched: np.ndarray
) -> np.ndarray:
    """Return the (H, W) correlations of both views along disparities; -1 where nothing matches."""
    row, column = np.indices(disparity.shape, dtype=np.float32)
    x = np.where(matched, column - disparity, -1).astype(np.float32)
    aligned = cv2.remap(views[1], x, row, cv2.INTER_LINEAR)
    inside = cv2.remap(shown[1].astype(np.uint8), x, row, cv2.INTER_NEAREST) > 0
    correlation = local_zncc(
        gaussian_blur(views[0], CORRELATION_SIGMA_PX),
        gaussian_blur(aligned, CORRELATION_SIGMA_PX),
        np.ones(row.shape, bool),
        CORRELATION_WINDOW_PX,
    )
    matched = matched & shown[0] & inside
    return np.where(matched, np.nan_to_num(correlation), np.float32(-1))


def _range_of_matches(frame: RectifiedFrame, sparse: Pair) -> DisparityRange:
    """Return the range of the disparities of sparse matches, with a margin at both ends."""
    disparity = frame.to_frame(sparse[0], 0)[:, 0] - frame.to_frame(sparse[1], 1)[:, 0]
    disparity = disparity[np.isfinite(disparity)]
    if not len(disparity):
        return 0, 0
    smallest, largest = range_with_margin(disparity, MARGIN_PX, MARGIN_FRACTION)
    widest = frame.size[0] - 1
    return max(math.floor(smallest), -widest), min(math.ceil(largest), widest)


def _track(view: RectifiedView) -> Pair | None:
    """Track corners of the first view, from where disparities predict them in the second.

    Returns the corners in both images at full size; None with fewer than `MIN_TRACKS` tracks.
    """
    first, second = (equalise(gray) for gray in view.views)
    mask = np.isfinite(view.disparity).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(first, CORNERS, 0.001, 5, mask=mask)
    if corners is None or len(corners) < MIN_TRACKS:
        return None
    start = corners.reshape(-1, 2)
    column, row = np.rint(start).astype(np.int64).T
    disparity = view.disparity[row, column]
    expected = start - np.column_stack([disparity, np.zeros(len(start))]).astype(np.float32)
    ends, gaps = track_round_trip(first, second, start, WINDOW_PX, levels=1, expected=expected)
    good = gaps < MAX_ROUND_TRIP_PX
    if np.count_nonzero(good) < MIN_TRACKS:
        return None
    start, ends = start[good], ends[good]
    return view.from_frame(start, 0), view.from_frame(ends, 1)


def _agreement(view: RectifiedView, sparse: Pair) -> float:
    """Return the fraction of sparse matches that agree with the disparity where they start.

    Matches that start where there is no disparity are left out. If most of the others disagree,
    rows were matched to similar but wrong places.
    """
    positions = [view.to_frame(points, side) for side, points in enumerate(sparse)]
    inside, column, row = view.pixels_of(positions[0])
    errors = positions[0][inside, 0] - positions[1][inside, 0] - view.disparity[row, column]
    errors = np.abs(errors[np.isfinite(errors)])
    return float((errors < MAX_DISAGREEMENT_PX * view.step_px).mean()) if len(errors) else 0.0


def _moved_to_lines(
    points0: np.ndarray, points1: np.ndarray, fundamental: np.ndarray
) -> np.ndarray:
    """Move the second positions of matches to the nearest points on their epipolar lines."""
    lines = np.column_stack([points0, np.ones(len(points0))]) @ fundamental.T
    normal = lines[:, :2]
    distance = (normal * points1).sum(axis=1) + lines[:, 2]
    squared = np.maximum((normal**2).sum(axis=1), 1e-300)
    return np.asarray(points1 - normal * (distance / squared)[:, None])


def _sample(view: RectifiedView, xy0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices of keypoints with a disparity, their matches' positions, and scores."""
    disparity = view.disparity
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
            weight *= np.abs(value - nearest) <= 1  # 0 where the disparity is NaN
            total += weight * np.nan_to_num(value - nearest)
            weights += weight
    shift = np.column_stack([nearest + total / weights, np.zeros(len(rows))])
    scores = np.clip(view.correlation[row, column], 0, 1)
    return rows, view.from_frame(positions - shift, 1), scores
