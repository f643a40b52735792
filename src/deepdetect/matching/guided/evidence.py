"""Evidence for or against matches: repeated patterns, held-out windows, and neighbours.

**Repeated patterns** (windows, tiles, fences). Patches look as similar one period further on, so
they cannot tell a homography from a shifted copy. So the aligned images are correlated at all
shifts. If one of these is nearly as good, two things decide: the places that only one of the two
homographies explains, and sparse matches off the plane, which only agree on an epipole with the
correct homography.

**Held-out windows.** The matches around a window predict, by an affine map, where the second image
shows it. Correct matches predict similar content; chance matches predict unrelated content.

**Neighbours** of a correct sparse match move as it does.
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
"""Images are reduced to this longer side to compare shifts: periods are many pixels long."""

MIN_SHIFT_PX = 10
"""Shorter shifts of the reduced images are ignored: aligned images correlate there anyway."""

MAX_SHIFTS = 4
"""Only the best shifts are compared, up to this number. Chosen by hand."""

MIN_RELATIVE_CORRELATION = 0.4
"""A shift is compared if it correlates at least this well, relative to no shift. Planes of Oxford
have up to 0.27, Strecha's entry up to 0.40, synthetic facades of one window 0.48 or more."""

MIN_OVERLAP = 0.6
"""Shifts must keep this fraction of the overlap, because distinctive content may be hidden."""

MIN_ZNCC, MIN_ZNCC_GAIN = 0.5, 0.2
"""A homography explains a place if the ZNCC there is above the first. It explains the place alone
if the ZNCC of the other homography is lower by the second. Chosen by hand."""

MIN_OWN_FRACTION, MIN_OWN_RATIO = 0.02, 2.0
"""The places that a homography explains alone must be at least the first fraction of all explained
places, and the second number times the places that its shifted copy explains alone. Chosen by
hand."""

MIN_EXPLAINED_FRACTION = 0.25
"""A homography must explain this fraction of the places of sparse matches if few places can be
compared. Correct matches have 0.44 or more, two unrelated photographs 0."""

OFF_PLANE_PX = 6.0
"""A match with a larger transfer error under the homography is off the plane. Chosen by hand."""

HELD_OUT_SIDE_PX = 640
"""Images are reduced to this longer side before held-out windows are compared. Chosen by hand."""

WINDOW_PX = 16
"""Side of the windows that divide the reduced first image, in pixels. Chosen by hand."""

MIN_AROUND = 5
"""A window is predicted if this many of its eight neighbours have matches. Chosen by hand."""

MIN_COMPARED = 20
"""Fewer comparable places or windows decide nothing. Chosen by hand."""

FALSE_POSITIVE_RATE = 0.05
"""Matches pass if their window, averaged with those around it, is more similar than all but this
fraction of unrelated windows. Chosen by hand."""

NEIGHBOURS = 8
"""Each sparse match is compared with this many of the nearest ones. Chosen by hand."""

MAX_MOVE_DIFFERENCE, MOVE_NOISE_PX = 0.35, 2.0
"""Steps between matches agree if rotation and scale differ by at most the first, relative to the
scale. This allows for tilt and depth. The second is the error of a step in pixels. Chosen by
hand."""


def is_repeated(
    grays: Pair,
    points0: np.ndarray,
    homography: np.ndarray,
    sparse: Pair | None = None,
    seed: int = 0,
    distinct: bool = False,
) -> bool:
    """Return whether a shifted copy of a homography explains (N, 2) points as well as it does.

    The points are those of dense matches or, if `distinct`, of sparse matches by the ratio test.
    `sparse` are all tentative matches, (M, 2) in both images, many of them wrong: relative to the
    correct homography, what lies off the plane moves towards an epipole.
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
            continue  # refined back to the first homography
        # If the pattern ends in both images, its rest may be hidden. So only what does not recur
        # in the first image distinguishes both places.
        recurring = [warped_zncc(first, first, move) for move in (step, np.linalg.inv(step))]
        recurs = np.fmax(*recurring)[places] > MIN_ZNCC
        explained = np.fmax(own, others) > MIN_ZNCC  # not for NaN in both
        known = explained & np.isfinite(own) & np.isfinite(others)
        gain = (own - others)[known]
        alone = np.sum((gain > MIN_ZNCC_GAIN) & ~recurs[known])
        other_alone = np.sum(gain < -MIN_ZNCC_GAIN)
        least = max(MIN_OWN_FRACTION * len(gain), MIN_OWN_RATIO * other_alone)
        if len(gain) < MIN_COMPARED:
            # Distinctive descriptors suffice if most of their matches look alike and no place
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
    """Return whether matches off the plane agree on an epipole with it, but not with its copy."""
    points0, points1 = sparse
    on_plane = transform_points(points1, np.linalg.inv(plane))
    starts, ends = (scaled_points(points, scale0) for points in (points0, on_plane))
    shown = ((ends > 0) & (ends < np.array(first.shape[::-1]) - 1)).all(axis=1)
    ends[~shown] = 0
    # A match is of the pattern if the place where the plane maps its end looks like its start.
    alike = zncc_at_points((first, first), (starts, ends), WINDOW_PX) > MIN_ZNCC
    recurs = ~shown | (alike & (np.linalg.norm(ends - starts, axis=1) > MIN_SHIFT_PX))
    errors = [transfer_errors(points0, points1, each) for each in (plane, copy)]
    off = ~recurs & (np.minimum(*errors) > OFF_PLANE_PX)
    own, other = (
        measure_parallax(points0[off], points1[off], each, seed).log10_nfa for each in (plane, copy)
    )
    return own < min(other, 0) + MAX_LOG10_NFA


def _similar_shifts(first: np.ndarray, warped: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the shifts (dx, dy) at which aligned images correlate nearly as well as unshifted."""
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
    """Compare each window of the first image with where the matches around it predict it.

    The matches are (M, 2) in both images. Returns the median correlation of the windows, 0 if too
    few can be compared, and (M,) bool: False for matches whose window looks like unrelated ones.
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
    """Average the values of windows, (rows, columns), over 3 x 3 windows; NaN stays NaN."""
    known = np.isfinite(values)
    total, count = (
        cv2.boxFilter(part, cv2.CV_64F, (3, 3), borderType=cv2.BORDER_CONSTANT)
        for part in (np.where(known, values, 0), known.astype(np.float32))
    )
    return np.where(known, total / np.maximum(count, 1e-9), np.nan)


def _affine_maps(
    windows: np.ndarray, points0: np.ndarray, points1: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Fit an affine map, (3, 2), to the matches of the eight windows around each window.

    `windows` (M,) are the matches' windows in a grid of `shape`. Also returns where maps exist.
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
    """Return the fraction of the nearest matches that move as each of (M, 2) matches does.

    Each neighbour and the match itself give a rotation and a scale. The largest group of neighbours
    that agree with one of them is counted.
    """
    neighbours = min(NEIGHBOURS, len(points0) - 1)
    if neighbours < 1:
        return np.zeros(len(points0))
    first, second = points0 @ [1, 1j], points1 @ [1, 1j]
    blocks = np.array_split(first, len(first) // 500 + 1)  # bounds the memory of the distances
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
