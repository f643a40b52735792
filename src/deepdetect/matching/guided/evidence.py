"""Evidence for or against matches: repeated patterns, held-out windows, and neighbours.

**Repeated patterns** (windows, tiles, fences). A homography that is off by one period of a pattern
aligns patches as well as the correct homography does. So the aligned images are correlated at all
shifts. If one shift correlates nearly as well as no shift, two things decide between the homography
and its shifted copy: the places that only one of the two explains, and the sparse matches off the
plane, which agree on an epipole only relative to the correct homography.

**Held-out windows.** An affine map, fitted to the matches around a window, predicts where the
second image shows the window. If these matches are correct, the content there is similar; if they
arose by chance, it is unrelated.

**Neighbours.** A correct sparse match moves as its neighbours do.
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

COMPARED_SIDE_PX, DETAILED_SIDE_PX = 320, 1280
"""Images are reduced to the first longer side before shifts are compared, because the periods of
patterns are many pixels long. What differs from period to period, as the numbers of a table do, may
show only in images of the second side."""

MIN_SHIFT_PX = 10
"""Shorter shifts of the reduced images are ignored, because aligned images correlate there."""

MAX_SHIFTS = 4
"""Maximum number of shifts that are tested: those with the highest correlation. Chosen by hand."""

MIN_RELATIVE_CORRELATION = 0.4
"""A shift is tested if its correlation is above this fraction of the correlation without a shift.
The fraction is up to 0.27 for the planar scenes of Oxford, up to 0.40 for Strecha's scene "entry",
and 0.48 or more for synthetic facades that repeat one window."""

MIN_OVERLAP = 0.6
"""A shift is tested only if at least this fraction of the overlap remains after it. With less, the
content that would refute the shift may be out of view."""

MIN_ZNCC, MIN_ZNCC_GAIN = 0.5, 0.2
"""A homography explains a place with a ZNCC above the first value. It alone explains the place if
its ZNCC also exceeds that of the other homography by more than the second. Chosen by hand."""

MIN_OWN_FRACTION, MIN_OWN_RATIO = 0.02, 2.0
"""A homography is preferred to its shifted copy if the places that it alone explains are at least
the first fraction of all explained places, and at least the second value times as many as those
that the copy alone explains. Chosen by hand."""

MIN_EXPLAINED_FRACTION = 0.25
"""A homography must explain more than this fraction of the sparse matches if fewer than
`MIN_COMPARED` places can be compared. The fraction is 0.44 or more for correct matches, 0 for
unrelated images."""

OFF_PLANE_PX = 6.0
"""A match with a larger transfer error under the homography is off the plane. Chosen by hand."""

HELD_OUT_SIDE_PX = 640
"""Images are reduced to this longer side before held-out windows are compared. Chosen by hand."""

WINDOW_PX = 16
"""Side of the windows that divide the reduced first image, in pixels. Chosen by hand."""

MIN_AROUND = 5
"""The place of a window in the second image is predicted only if at least this many of the eight
windows around it contain matches. Chosen by hand."""

MIN_COMPARED = 20
"""Comparisons of fewer places or windows than this decide nothing. Chosen by hand."""

FALSE_POSITIVE_RATE = 0.05
"""A match passes if the mean correlation of its window and those around it is above that of all but
this fraction of unrelated windows. Chosen by hand."""

NEIGHBOURS = 8
"""Each sparse match is compared with this many of its nearest sparse matches. Chosen by hand."""

MAX_MOVE_DIFFERENCE, MOVE_NOISE_PX = 0.35, 2.0
"""The steps from a match to a neighbour in both images give a rotation and a scale: one complex
number. Two numbers agree if they differ by less than the first value times their magnitude, for
tilt and depth, plus the second value, for position errors, over the step length. Chosen by hand."""


def is_repeated(
    grays: Pair,
    points0: np.ndarray,
    homography: np.ndarray,
    sparse: Pair | None = None,
    seed: int = 0,
    distinct: bool = False,
    flat: bool = False,
) -> bool:
    """Return whether a shifted copy of a homography explains the points as well as the original.

    `points0`, (N, 2), are positions in the first image of dense matches or, if `distinct`, of
    sparse matches that passed the ratio test. `sparse` are all tentative matches, (M, 2) in each
    image, many of them wrong. Off the plane, the correct ones agree on an epipole relative to the
    correct homography only. If `flat`, the caller knows that the images show one plane.
    """
    (first, scale0), (second, scale1) = (downscale(gray, COMPARED_SIDE_PX) for gray in grays)
    matrix = scaled_homography(homography, scale0, scale1)
    last = np.array(first.shape[::-1]) - 1
    x, y = np.rint(scaled_points(points0, scale0)).clip(0, last).astype(np.int64).T
    places = np.zeros(first.shape, bool)
    places[y, x] = True
    for shift in similar_shifts(first, *warp_to_reference(second, matrix, first.shape[::-1])):
        other = refine_homography(first, second, matrix @ translation_matrix(*shift))
        middle = np.array([last / 2])
        if transfer_errors(middle, middle, np.linalg.inv(matrix) @ other)[0] < MIN_SHIFT_PX:
            continue  # the refinement undid the shift
        compared = _compare(first, second, matrix, other)
        # Matches along one edge fit any shift along it, but the rest of the images may decide.
        if _preferred(compared[:, places], distinct, flat) or _preferred(compared, flat=flat):
            continue
        copy = scaled_homography(other, 1 / scale0, 1 / scale1)
        if sparse and _parallax_decides(first, scale0, sparse, homography, copy, seed):
            continue
        if not flat:
            return True
        (large0, by0), (large1, by1) = (downscale(gray, DETAILED_SIDE_PX) for gray in grays)
        own, other = (scaled_homography(each, by0, by1) for each in (homography, copy))
        other = refine_homography(large0, large1, other)
        if not _preferred(_compare(large0, large1, own, other), flat=flat):
            return True
    return False


def _compare(
    first: np.ndarray, second: np.ndarray, matrix: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Return ZNCCs by a homography, by its copy, and one period on in the first image, stacked."""
    step = np.linalg.inv(matrix) @ other
    recurring = (warped_zncc(first, first, move) for move in (step, np.linalg.inv(step)))
    own, others = (warped_zncc(first, second, each) for each in (matrix, other))
    return np.stack([own, others, np.fmax(*recurring)])


def _preferred(compared: np.ndarray, distinct: bool = False, flat: bool = False) -> bool:
    """Return whether (3, ...) ZNCCs of `_compare` prefer a homography to its copy.

    Content that recurs one shift away in the first image is no evidence for the homography: where
    the pattern ends, its next period may just be hidden. If `flat`, what has been written over a
    period is no evidence for the copy either.
    """
    own, others, recurring = compared
    best = np.fmax(own, others)  # NaN where both are
    known = (best > MIN_ZNCC) & np.isfinite(own) & np.isfinite(others)
    recurs = recurring > MIN_ZNCC
    if flat:
        recurs &= recurring > best - MIN_ZNCC_GAIN
    gain = (own - others)[known]
    alone = np.sum((gain > MIN_ZNCC_GAIN) & ~recurs[known])
    other_alone = np.sum((gain < -MIN_ZNCC_GAIN) & ~(flat & recurs[known]))
    if len(gain) < MIN_COMPARED:
        # With so few places, the distinctive descriptors of sparse matches suffice if enough of
        # their patches look alike and the copy alone explains no place.
        alike = np.mean(own > MIN_ZNCC) > MIN_EXPLAINED_FRACTION
        return bool(distinct and alike and not other_alone)
    return bool(alone >= max(MIN_OWN_FRACTION * len(gain), MIN_OWN_RATIO * other_alone))


def _parallax_decides(
    first: np.ndarray, scale0: float, sparse: Pair, plane: np.ndarray, copy: np.ndarray, seed: int
) -> bool:
    """Return whether matches off `plane` agree on an epipole relative to it, but not to `copy`."""
    points0, points1 = sparse
    on_plane = transform_points(points1, np.linalg.inv(plane))
    starts, ends = (scaled_points(points, scale0) for points in (points0, on_plane))
    shown = ((ends > 0) & (ends < np.array(first.shape[::-1]) - 1)).all(axis=1)
    ends[~shown] = 0
    # A match belongs to the pattern if its start looks like the place in the first image to which
    # the plane maps its end back.
    alike = zncc_at_points((first, first), (starts, ends), WINDOW_PX) > MIN_ZNCC
    recurs = ~shown | (alike & (np.linalg.norm(ends - starts, axis=1) > MIN_SHIFT_PX))
    errors = [transfer_errors(points0, points1, each) for each in (plane, copy)]
    off = ~recurs & (np.minimum(*errors) > OFF_PLANE_PX)
    own, other = (
        measure_parallax(points0[off], points1[off], each, seed).log10_nfa for each in (plane, copy)
    )
    return own < min(other, 0) + MAX_LOG10_NFA


def similar_shifts(first: np.ndarray, warped: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the shifts (dx, dy), best first, at which two aligned images also correlate well."""
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
    """Compare windows of the first image with the places that the (M, 2) matches around predict.

    Returns the median correlation of the windows, 0 if too few can be compared, and (M,) bool,
    false for matches whose window is no more similar than unrelated windows.
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
    alike = ~(_mean_around(own) <= bound)  # True for unknown windows (NaN)
    return float(np.nanmedian(own)), alike[row, column]


def _mean_around(values: np.ndarray) -> np.ndarray:
    """Average each cell of a 2-D grid with its eight neighbours; NaN is left out and stays NaN."""
    known = np.isfinite(values)
    total, count = (
        cv2.boxFilter(part, cv2.CV_64F, (3, 3), borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0), known.astype(np.float32))
    )
    return np.where(known, total / np.maximum(count, 1e-9), np.nan)


def _affine_maps(
    windows: np.ndarray, points0: np.ndarray, points1: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """For each window of a grid, fit an affine map to the matches of the eight windows around it.

    `windows` holds the (M,) indices of the matches' windows in the flattened grid. Returns the
    (rows, columns, 3, 2) maps, and a (rows, columns) bool array, true where a map exists.
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
    """Return, for each of (M, 2) matches, the fraction of its nearest matches that move as it does.

    Each neighbour gives a rotation and a scale (see `MAX_MOVE_DIFFERENCE`). The largest group of
    neighbours that agree with one of them counts as moving like the match.
    """
    neighbours = min(NEIGHBOURS, len(points0) - 1)
    if neighbours < 1:
        return np.zeros(len(points0))
    first, second = points0 @ [1, 1j], points1 @ [1, 1j]
    blocks = np.array_split(first, len(first) // 500 + 1)  # in blocks, to bound the memory
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
