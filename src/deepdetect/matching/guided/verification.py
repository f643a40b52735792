"""Verification of matches: whether patches look the same once the two images are aligned.

The second image is warped into the frame of the first. At each point, SIFT descriptors of both
images, in two sizes, are compared by their correlation, after the mean of all descriptors is
subtracted. Null pairs are unrelated patches, from a warped image that is shifted by a third of its
size or more. A point passes if its distance (1 - correlation), averaged over its neighbours, is
below that of nearly all null pairs, and if most points around it pass. To save time, descriptors
are computed only at the points of a lattice that are nearest to the keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...features.sift import correlation_distance, dense_sift, sift_gradient, to_root_sift
from ...geometry.images import gaussian_means, window_sums

DESCRIPTOR_REACH = 36
"""Radius of the area on which the largest descriptor depends. Farther than this from the border, a
shift of the image leaves descriptors unchanged, so they are computed only once."""

KEYPOINT_SIZES_PX = (3.0, 8.0)
"""Descriptors are compared at these keypoint diameters. Chosen by hand."""

LATTICE_PX = 3
"""Spacing of the lattice of descriptors. Pixels in between have nearly the same descriptors."""

FALSE_POSITIVE_RATE = 0.01
"""Fraction of null pairs (unrelated patches of the two images) that pass. This bound and the sizes
of the windows were chosen on nine pairs of Oxford with parts of their second images covered."""

SMOOTHING_SIGMA_PX = 2.5
"""Sigma of the Gaussian average over distances of neighbouring points. Chosen by hand."""

WINDOWS_PX = (101, 31)
"""A point passes if most points in each of two square windows around it pass. The smaller window,
chosen on six synthetic pairs, is against chance matches around a small plane."""

MIN_SUPPORT = 0.5
"""A point passes only if at least this fraction of the points in each window around it passes."""

NULL_SHIFTS = ((1 / 2, 0), (0, 1 / 2), (1 / 3, 1 / 3))
"""Shifts between the patches of a null pair, as fractions of width and height."""

NULL_BLOCK_PX = 64
"""Null pairs come from whole blocks of this side: neighbours are averaged. Chosen by hand."""

MAX_NULL_BLOCKS = 256
"""Maximum number of random blocks per shift. Images of up to a megapixel have no more blocks."""

MIN_POINTS_OF_MEAN = 100
"""The mean descriptor is subtracted only if it is the mean of at least this many descriptors,
because a mean of few is close to each of them."""

MIN_NULL_DISTANCE = 1e-6
"""The distance of equal descriptors is 0, except for rounding errors of at most this."""


@dataclass(frozen=True, eq=False)
class NullPairs:
    """Points of the first image paired with unrelated places of the second, for one shift.

    `rows`, (N,), are indices of described points, and `partners`, (N, 2), their unrelated places in
    the second image before the shift. `shifted` is the second image, shifted cyclically. `interior`
    marks pairs so far from the border that the shift does not change their descriptors.
    """

    rows: np.ndarray
    partners: np.ndarray
    interior: np.ndarray
    shifted: np.ndarray


def dissimilarity(
    gray0: np.ndarray, warped: np.ndarray, valid: np.ndarray, pixels: np.ndarray, seed: int = 0
) -> np.ndarray:
    """Compare the patches of two aligned images around (N, 2) integer `pixels`.

    `warped` is the second image in the frame of the first, `gray0`, with content where `valid`.
    Returns (N,) float32: 1 - correlation, averaged over neighbours, divided by the
    `FALSE_POSITIVE_RATE` quantile of the null pairs. Patches match if it is below 1. It is infinite
    without content, if most points around differ, or if all null pairs look the same.
    """
    pixels = np.asarray(pixels).astype(np.int64)
    result = np.full(len(pixels), np.inf, np.float32)
    known = np.flatnonzero(valid[pixels[:, 1], pixels[:, 0]])
    if not len(known):
        return result
    seen, shape = pixels[known], gray0.shape
    described = _lattice_near(seen, shape)
    described = described[valid[described[:, 1], described[:, 0]]]
    null_pairs = sample_null_pairs(described, warped, valid, seed)
    distances, null_distances = _distances(gray0, warped, described, null_pairs)
    null_means = []
    for null, values in zip(null_pairs, null_distances, strict=True):
        points = described[null.rows]
        null_means.append(gaussian_means(points, values, shape, SMOOTHING_SIGMA_PX, points))
    together = np.concatenate(null_means)
    bound = np.quantile(together, FALSE_POSITIVE_RATE) if len(together) else 0
    if bound <= MIN_NULL_DISTANCE:  # all null pairs look the same: similarity says nothing
        return result
    means = gaussian_means(described, distances, shape, SMOOTHING_SIGMA_PX, seen)
    ratios = means / np.float32(bound)
    supported = np.ones(len(seen), bool)
    for window in WINDOWS_PX:
        count, passed = (
            window_sums(seen, part, shape, window, dtype=np.float32) for part in (1, ratios < 1)
        )
        supported &= passed >= MIN_SUPPORT * count
    result[known] = np.where(supported, ratios, np.inf)
    return result


def sample_null_pairs(
    points: np.ndarray, warped: np.ndarray, valid: np.ndarray, seed: int = 0
) -> list[NullPairs]:
    """For each shift, pair points in random blocks with unrelated places of the second image.

    `points` are the (N, 2) described points; for the other arguments see `dissimilarity`.
    """
    size = np.array(warped.shape[::-1])
    # Shifts by multiples of the lattice step keep most partners on the lattice of descriptors.
    step = LATTICE_PX
    period = np.maximum(size // step, 1) * step
    rows_and_columns = [np.arange(length) for length in warped.shape]
    result = []
    for rows, fraction in zip(_sample_blocks(points, seed), NULL_SHIFTS, strict=True):
        shift = np.rint(np.array(fraction) * period / step).astype(np.int64) * step
        partners = (points[rows] - shift) % period
        inner, whole = (
            (np.minimum(xy, end - 1 - xy) >= DESCRIPTOR_REACH).all(axis=1)
            for xy, end in ((points[rows], size), (partners, period))
        )
        # A pair is dropped if only its partner is near an edge, because the shifted image then has
        # a seam there that `warped` does not have.
        kept = valid[partners[:, 1], partners[:, 0]] & (whole | ~inner)
        y, x = (
            (line - by) % end
            for line, by, end in zip(rows_and_columns, shift[::-1], period[::-1], strict=True)
        )
        shifted = warped[np.ix_(y, x)]
        result.append(NullPairs(rows[kept], partners[kept], inner[kept], shifted))
    return result


def _distances(
    gray0: np.ndarray, warped: np.ndarray, points: np.ndarray, null_pairs: Sequence[NullPairs]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return 1 - correlation at the points and of the null pairs, summed over keypoint sizes."""
    # Each place of the second image is described once, even if it is in several null pairs.
    used = [points, *(null.partners[null.interior] for null in null_pairs)]
    index = np.full(warped.shape, -1, np.int32)
    for x, y in (each.T for each in used):
        index[y, x] = 0
    pixels = np.argwhere(index == 0)[:, ::-1]
    index[pixels[:, 1], pixels[:, 0]] = np.arange(len(pixels))
    rows_of_points = index[points[:, 1], points[:, 0]]
    distances = np.zeros(len(points), np.float32)
    null_distances = [np.zeros(len(null.rows), np.float32) for null in null_pairs]
    gradients = [sift_gradient(gray) for gray in (gray0, warped)]
    shifted = [sift_gradient(null.shifted) for null in null_pairs]
    for size in KEYPOINT_SIZES_PX:
        described = dense_sift(gray0, points, size, LATTICE_PX, gradients[0])
        first = to_root_sift(described)
        total = first.sum(axis=0, dtype=np.int64)  # exact: the order of the points does not matter
        enough = len(first) >= MIN_POINTS_OF_MEAN
        mean = (total / len(first) if enough else 0 * total).astype(np.float32)
        described = dense_sift(warped, pixels, size, LATTICE_PX, gradients[1])
        second = to_root_sift(described)
        distances += correlation_distance(
            first, np.arange(len(first)), second, rows_of_points, mean
        )
        for values, null, gradient in zip(null_distances, null_pairs, shifted, strict=True):
            x, y = null.partners[null.interior].T
            inner, outer = null.rows[null.interior], null.rows[~null.interior]
            values[null.interior] += correlation_distance(first, inner, second, index[y, x], mean)
            described = dense_sift(null.shifted, points[outer], size, LATTICE_PX, gradient)
            others = to_root_sift(described)
            rows = np.arange(len(outer))
            values[~null.interior] += correlation_distance(first, outer, others, rows, mean)
    return distances, null_distances


def _lattice_near(pixels: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the lattice points, (M, 2) and each once, that are nearest to (N, 2) pixels."""
    last = (np.array(shape[1::-1]) - 1 - LATTICE_PX // 2) // LATTICE_PX
    index = np.clip(pixels // LATTICE_PX, 0, np.maximum(last, 0))
    used = np.zeros(index.max(axis=0) + 1, bool)
    used[index[:, 0], index[:, 1]] = True
    centres = np.argwhere(used) * LATTICE_PX + LATTICE_PX // 2
    return np.minimum(centres, np.array(shape[1::-1]) - 1)


def _sample_blocks(pixels: np.ndarray, seed: int) -> list[np.ndarray]:
    """Return, for each shift, the indices of the points in randomly chosen blocks."""
    block = pixels // NULL_BLOCK_PX
    number = block[:, 1] * 1_000_000 + block[:, 0]
    order = np.random.default_rng(seed).permutation(np.unique(number))
    # Each shift gets blocks of its own if there are enough.
    most, shifts = MAX_NULL_BLOCKS, range(len(NULL_SHIFTS))
    chosen = [np.roll(order, -shift * most)[:most] for shift in shifts]
    return [np.flatnonzero(np.isin(number, blocks)) for blocks in chosen]
