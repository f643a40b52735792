"""Evidence beside the matches themselves: repeated patterns, and windows that are held out.

**Repeated patterns** (windows, tiles, fences). Patches cannot tell: they are as much alike one
period further on. So the aligned images are correlated at all shifts, and where one of these is
nearly as good, the places that only one of the two homographies explains decide; or sparse matches
off both planes, which agree on an epipole with the right one.

**Held-out windows.** The matches of the windows around one predict, by an affine map, where it is
seen in the second image. Right matches predict what looks alike there; what was matched by chance
does not.

**Neighbours** of a sparse match move as it does.
"""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2
from ...geometry.estimation import MAX_LOG10_NFA, measure_parallax
from ...geometry.homography_refinement import refine_homography
from ...geometry.images import (
    BLUR_SIGMA_PX,
    downscale,
    gaussian_blur,
    local_zncc,
    normalise_local_contrast,
    warp_to_reference,
    warped_zncc,
    zncc_at_points,
)
from ...geometry.transforms import (
    scaled_homography,
    scaled_points,
    transfer_errors,
    transform_points,
    translation_matrix,
)
from .tentative_matches import Pair

COMPARED_SIDE_PX = 320
"""Longer side to which images are reduced for shifts: periods of a pattern are many pixels."""

MIN_SHIFT_PX = 10
"""Of the reduced images: nearer the correlation is that of what is aligned."""

MAX_SHIFTS = 4
"""That are compared, the best."""

MIN_RELATIVE_CORRELATION = 0.4
"""Of a shift, relative to that without one, for it to be compared. Planes of Oxford have up to
0.27, those of Strecha's entry up to 0.40, made facades of one window from 0.48 on."""

MIN_OVERLAP = 0.6
"""Of the overlap without a shift, that there is after it: else what tells them apart is hidden."""

MIN_ZNCC, MIN_ZNCC_GAIN = 0.5, 0.2
"""A place is explained with this correlation, and by one homography alone where that of the other
is lower by this."""

MIN_OWN_FRACTION, MIN_OWN_RATIO = 0.02, 2.0
"""Of the explained places, those that a homography explains alone, and how many times those that
its shifted copy explains alone."""

MIN_EXPLAINED_FRACTION = 0.25
"""Of the places of sparse matches, those that a homography explains: of right ones that few places
can confirm from 0.44 on, of two unrelated photographs none."""

OFF_PLANE_PX = 6.0
"""Matches that end this far from where the homography takes them are off the plane."""

HELD_OUT_SIDE_PX = 640
"""Longer side to which images are reduced for held-out windows."""

WINDOW_PX = 16
"""Side of the windows, which divide the first image."""

MIN_AROUND = 5
"""Of the eight windows around one, those with matches, for them to predict where it is seen."""

MIN_COMPARED = 20
"""With fewer places, or windows, that can be compared nothing is known."""

FALSE_POSITIVE_RATE = 0.05
"""Fraction of the unrelated windows that are as much alike, with those around them, as those of
matches that the images do not contradict."""

NEIGHBOURS = 8
"""Sparse matches around one that are compared with it."""

MAX_MOVE_DIFFERENCE, MOVE_NOISE_PX = 0.35, 2.0
"""By which turn and scale of two steps between matches may differ, relative to the scale: what is
tilted or has depth moves so; and by which a step may be wrong."""


def is_repeated(
    grays: Pair,
    points0: np.ndarray,
    homography: np.ndarray,
    sparse: Pair | None = None,
    seed: int = 0,
    distinct: bool = False,
) -> bool:
    """Return whether a shifted copy of a homography explains (N, 2) points as well as it does.

    The points are of dense matches, or of `distinct` ones: sparse matches by the ratio test.
    And the `sparse` matches, (M, 2) in both images, of all that is seen, many of them wrong: what
    does not recur off a plane moves towards an epipole where its homography is the right one.
    """
    (first, scale0), (second, scale1) = (downscale(gray, COMPARED_SIDE_PX) for gray in grays)
    matrix = scaled_homography(homography, scale0, scale1)
    last = np.array(first.shape[::-1]) - 1
    x, y = np.rint(scaled_points(points0, scale0)).clip(0, last).astype(np.int64).T
    places = np.zeros(first.shape, bool)
    places[y, x] = True
    own = warped_zncc(first, second, matrix)[places]
    for shift in _similar_shifts(first, *warp_to_reference(second, matrix, first.shape[::-1])):
        other = refine_homography(first, second, matrix @ translation_matrix(*shift))
        others = warped_zncc(first, second, other)[places]
        step = np.linalg.inv(matrix) @ other
        middle = np.array([last / 2])
        if transfer_errors(middle, middle, step)[0] < MIN_SHIFT_PX:
            continue  # it is the first one again
        # Where the pattern ends in both images, the rest of it may be hidden: only what does not
        # recur in the first image tells both places apart.
        recurring = [warped_zncc(first, first, move) for move in (step, np.linalg.inv(step))]
        recurs = np.fmax(*recurring)[places] > MIN_ZNCC
        explained = np.fmax(own, others) > MIN_ZNCC  # not for NaN in both
        known = explained & np.isfinite(own) & np.isfinite(others)
        gain = (own - others)[known]
        alone = np.sum((gain > MIN_ZNCC_GAIN) & ~recurs[known])
        other_alone = np.sum(gain < -MIN_ZNCC_GAIN)
        least = max(MIN_OWN_FRACTION * len(gain), MIN_OWN_RATIO * other_alone)
        if len(gain) < MIN_COMPARED:
            # Descriptors that occur once are enough if what they match looks alike, and no place
            # contradicts them.
            alike = np.mean(own > MIN_ZNCC) > MIN_EXPLAINED_FRACTION
            least = 0 if distinct and alike and not other_alone else np.inf
        if alone < least:
            copy = scaled_homography(other, 1 / scale0, 1 / scale1)
            if sparse is None or not _parallax_decides(
                first, scale0, sparse, homography, copy, seed
            ):
                return True
    return False


def _parallax_decides(
    first: np.ndarray, scale0: float, sparse: Pair, plane: np.ndarray, copy: np.ndarray, seed: int
) -> bool:
    """Whether what lies off a plane, and off its copy, agrees on an epipole with it alone."""
    points0, points1 = sparse
    on_plane = transform_points(points1, np.linalg.inv(plane))
    starts, ends = (scaled_points(points, scale0) for points in (points0, on_plane))
    shown = ((ends > 0) & (ends < np.array(first.shape[::-1]) - 1)).all(axis=1)
    ends[~shown] = 0
    # Where the plane shows the same in the first image, further on, the match is of the pattern.
    alike = zncc_at_points((first, first), (starts, ends), WINDOW_PX) > MIN_ZNCC
    recurs = ~shown | (alike & (np.linalg.norm(ends - starts, axis=1) > MIN_SHIFT_PX))
    errors = [transfer_errors(points0, points1, each) for each in (plane, copy)]
    off = ~recurs & (np.minimum(*errors) > OFF_PLANE_PX)
    own, other = (
        measure_parallax(points0[off], points1[off], each, seed).log10_nfa for each in (plane, copy)
    )
    return own < min(other, 0) + MAX_LOG10_NFA


def _similar_shifts(first: np.ndarray, warped: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the shifts (dx, dy) after which aligned images correlate nearly as without one."""
    size = [cv2.getOptimalDFTSize(2 * side) for side in first.shape]

    def correlate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.fft.irfft2(np.conj(np.fft.rfft2(a, size)) * np.fft.rfft2(b, size), size)

    a, b = normalise_local_contrast(first), normalise_local_contrast(warped) * valid
    energy = np.maximum(correlate(a * a, valid), 1) * np.maximum(correlate(a * 0 + 1, b * b), 1)
    overlap = correlate(np.ones(first.shape), valid) >= MIN_OVERLAP * np.count_nonzero(valid)
    values = np.where(overlap, correlate(a, b) / np.sqrt(energy), -1.0)
    side = 2 * MIN_SHIFT_PX + 1
    peaks = (cv2.dilate(values, np.ones((side, side))) == values) & overlap
    peaks &= values > MIN_RELATIVE_CORRELATION * values[0, 0]
    shifts = np.argwhere(peaks)
    shifts = shifts[np.argsort(-values[peaks], kind="stable")]
    shifts = np.where(shifts > np.array(size) / 2, shifts - size, shifts)[:, ::-1]
    return shifts[np.abs(shifts).max(axis=1) > MIN_SHIFT_PX][:MAX_SHIFTS]


def compare_held_out(
    grays: Pair, points0: np.ndarray, points1: np.ndarray
) -> tuple[float, np.ndarray]:
    """Compare windows of two images where the matches around them, (M, 2) each, say.

    Returns their median correlation, 0 where too few can be compared, and (M,) bool: false for the
    matches whose own window is no more alike than unrelated ones.
    """
    (first, scale0), (second, scale1) = (downscale(gray, HELD_OUT_SIDE_PX) for gray in grays)
    points0, points1 = scaled_points(points0, scale0), scaled_points(points1, scale1)
    rows, columns = (side // WINDOW_PX for side in first.shape)
    everything = np.ones(len(points0), bool)
    if 0 in (rows, columns):
        return 0.0, everything
    first = gaussian_blur(first[: rows * WINDOW_PX, : columns * WINDOW_PX], BLUR_SIGMA_PX)
    last = np.array([columns, rows]) - 1
    column, row = ((points0 + 0.5) // WINDOW_PX).astype(np.int64).clip(0, last).T
    affine, known = _affine_maps(row * columns + column, points0, points1, (rows, columns))
    terms = affine.repeat(WINDOW_PX, 0).repeat(WINDOW_PX, 1)
    y, x = np.indices(first.shape)
    x1, y1 = (terms[..., 0, k] * x + terms[..., 1, k] * y + terms[..., 2, k] for k in (0, 1))
    inside = (x1 >= 0) & (x1 <= second.shape[1] - 1) & (y1 >= 0) & (y1 <= second.shape[0] - 1)
    inside &= known.repeat(WINDOW_PX, 0).repeat(WINDOW_PX, 1)
    blurred = gaussian_blur(second, BLUR_SIGMA_PX)
    seen = cv2.remap(blurred, x1.astype(np.float32), y1.astype(np.float32), cv2.INTER_LINEAR)
    own = local_zncc(first, seen, inside, WINDOW_PX, WINDOW_PX)
    shift = rows // 2 * WINDOW_PX, columns // 2 * WINDOW_PX
    others, shown = (np.roll(values, shift, (0, 1)) for values in (seen, inside))
    unrelated = local_zncc(first, others, shown, WINDOW_PX, WINDOW_PX)
    if min(np.isfinite(own).sum(), np.isfinite(unrelated).sum()) < MIN_COMPARED:
        return 0.0, everything
    bound = np.nanquantile(_mean_around(unrelated), 1 - FALSE_POSITIVE_RATE)
    alike = ~(_mean_around(own) <= bound)  # or not known
    return float(np.nanmedian(own)), alike[row, column]


def _mean_around(values: np.ndarray) -> np.ndarray:
    """Average windows with those around them, (rows, columns); NaN where one is not known."""
    known = np.isfinite(values)
    total, count = (
        cv2.boxFilter(part, cv2.CV_64F, (3, 3), borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0), known.astype(np.float32))
    )
    return np.where(known, total / np.maximum(count, 1e-9), np.nan)


def _affine_maps(
    windows: np.ndarray, points0: np.ndarray, points1: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit an affine map, (3, 2), to the matches of the windows around each of (rows, columns).

    By the number of the window of each match. Returns where there is one, too, (rows, columns).
    """
    size = shape[0] * shape[1]

    def around(own: np.ndarray) -> np.ndarray:
        own = own.reshape(shape).astype(np.float64)
        box = cv2.boxFilter(own, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(box - own)

    left = np.column_stack([points0, np.ones(len(points0))])
    squares, products = (
        np.array([[around(np.bincount(windows, a * b, size)) for b in right.T] for a in left.T])
        for right in (left, points1)
    )
    known = around(np.bincount(windows, minlength=size) > 0) >= MIN_AROUND
    affine = np.zeros((*shape, 3, 2))
    affine[known] = np.linalg.solve(
        np.moveaxis(squares[..., known], -1, 0), np.moveaxis(products[..., known], -1, 0)
    )
    return affine, known


def moving_alike(points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
    """Return the fraction of the matches nearest to each of (M, 2) that move as it does.

    Each of them and the match itself give a turn and a scale; those count that agree with one.
    """
    neighbours = min(NEIGHBOURS, len(points0) - 1)
    if neighbours < 1:
        return np.zeros(len(points0))
    first, second = points0 @ [1, 1j], points1 @ [1, 1j]
    blocks = np.array_split(first, len(first) // 500 + 1)  # all distances of many fill the memory
    distances = (np.abs(block[:, None] - first) for block in blocks)
    nearest = np.concatenate(
        [np.argpartition(each, neighbours)[:, : neighbours + 1] for each in distances]
    )
    own = nearest == np.arange(len(first))[:, None]
    nearest = np.take_along_axis(nearest, np.argsort(own, axis=1, kind="stable"), 1)[:, :-1]
    steps = first[nearest] - first[:, None]
    moves = (second[nearest] - second[:, None]) / steps
    allowed = MAX_MOVE_DIFFERENCE * np.abs(moves)[:, :, None]
    allowed = allowed + MOVE_NOISE_PX / np.abs(steps)[:, None]
    alike = np.abs(moves[:, :, None] - moves[:, None]) < allowed
    return np.asarray(alike.sum(axis=2).max(axis=1) / neighbours)
