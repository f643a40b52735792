"""Dense matches of a scene with depth: the most similar keypoint near the epipolar line.

The line leaves one direction open, so a partner is searched (PatchMatch) in both images. A match is
kept when each of the two is the other's best partner or next to it, when the matches around it have
the same motion, when its patches are more similar than those of null pairs, and when many of the
keypoints around it are matched: of those behind something that only one image shows a few find a
partner by chance.
"""

from __future__ import annotations

import cv2
import numpy as np

from ...features.dense_sift import dense_sift
from ...features.matchers import DescriptorMatches
from ...features.matchers.patchmatch import epipolar_neighbours
from ...features.sift import to_root_sift
from ...geometry.windows import window_sums
from .homography import ImagePair
from .options import EpipolarMatchingOptions


def match_along_epipolar_lines(
    pair: ImagePair,
    fundamental: np.ndarray,
    options: EpipolarMatchingOptions = EpipolarMatchingOptions(),
    seed: int = 0,
) -> DescriptorMatches:
    """Match by a fundamental matrix, and keep matches that are similar and move consistently.

    Returns:
        The matches, their ratios the distance of their descriptors relative to null pairs, under 1.
    """
    xy0, xy1, shape = pair.xy0, pair.xy1, pair.gray0.shape
    none = np.empty(0, np.int64)
    nothing = DescriptorMatches(none, none, np.empty(0, np.float32))
    if len(xy0) < 2 or len(xy1) < 2:
        return nothing
    first, second = (
        to_root_sift(dense_sift(gray, xy, options.keypoint_size_px), overwrite=True)
        for gray, xy in ((pair.gray0, xy0), (pair.gray1, xy1))
    )
    band = options.max_epipolar_distance_px
    there, distances = epipolar_neighbours(first, second, seed, (xy0, xy1), fundamental, band)
    back, _ = epipolar_neighbours(second, first, seed, (xy1, xy0), fundamental.T, band)
    cycle_errors = np.linalg.norm(np.asarray(xy0)[back[there]] - np.asarray(xy0), axis=1)
    mutual = np.isfinite(distances) & (cycle_errors <= options.max_cycle_error_px)
    rows0 = np.flatnonzero(mutual)
    if not len(rows0):
        return nothing
    rows1 = there[rows0].astype(np.int64)
    ratios = distances[rows0] / _null_distance(first, second, seed, options)
    kept = ratios < 1
    rows0, rows1, ratios = rows0[kept], rows1[kept], ratios[kept]
    kept = motion_consistent(xy0[rows0], xy1[rows1], shape, options)
    rows0, rows1, ratios = rows0[kept], rows1[kept], ratios[kept]
    kept = densely_matched(xy0[rows0], xy0, shape, options)
    return DescriptorMatches(rows0[kept], rows1[kept], ratios[kept])


def motion_consistent(
    points0: np.ndarray,
    points1: np.ndarray,
    shape: tuple[int, ...],
    options: EpipolarMatchingOptions = EpipolarMatchingOptions(),
) -> np.ndarray:
    """Find the matches that move as those around them do (as in GMS); whole pixels, each once.

    Returns:
        (N,) bool: at least `min_motion_support` of the other matches in the window move so, and
        there is one.
    """
    pixels = np.asarray(points0).astype(np.int64)
    motion = (np.asarray(points1) - points0).astype(np.float32)
    flow = np.full((*shape[:2], 2), np.nan, np.float32)
    flow[pixels[:, 1], pixels[:, 0]] = motion
    window = options.motion_window_px
    reach = window // 2
    padded = cv2.copyMakeBorder(
        flow, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=(np.nan, np.nan)
    )
    others, consistent = np.zeros(len(pixels), np.int32), np.zeros(len(pixels), np.int32)
    for down in range(window):
        for across in range(window):
            if down == across == reach:
                continue
            there = padded[pixels[:, 1] + down, pixels[:, 0] + across]
            others += np.isfinite(there[:, 0])
            consistent += (np.abs(there - motion) <= options.max_motion_difference_px).all(1)
    return consistent >= np.maximum(options.min_motion_support * others, 1)


def densely_matched(
    points: np.ndarray,
    keypoints: np.ndarray,
    shape: tuple[int, ...],
    options: EpipolarMatchingOptions = EpipolarMatchingOptions(),
) -> np.ndarray:
    """Find the matched points around which many keypoints are matched; whole pixels, each once.

    Returns:
        (N,) bool: at least the fraction `min_match_density` of the keypoints in the window is
        matched, or `min_relative_density` of the median over all points where that is less.
    """
    if not len(points):
        return np.empty(0, bool)
    matched, everything = (np.asarray(xy).astype(np.int64) for xy in (points, keypoints))
    window = options.density_window_px
    found, possible = (
        window_sums(xy, 1, shape, window, at=matched, dtype=np.float32)
        for xy in (matched, everything)
    )
    densities = found / np.maximum(possible, 1)
    usual = options.min_relative_density * float(np.median(densities))
    return densities >= min(options.min_match_density, usual)


def _null_distance(
    first: np.ndarray, second: np.ndarray, seed: int, options: EpipolarMatchingOptions
) -> float:
    """Return the distance below which the fraction `false_positive_rate` of random pairs is."""
    generator = np.random.default_rng(seed)
    sample = [
        part[generator.integers(0, len(part), options.null_pairs)].astype(np.float32)
        for part in (first, second)
    ]
    distances = np.linalg.norm(sample[0] - sample[1], axis=1)
    return max(float(np.quantile(distances, options.false_positive_rate)), 1e-6)
