"""Refine a homography by the content of the two images; each step is cross-validated.

In two rounds, corners of the first image are tracked to the warped second image and back, and a
homography is fitted to the tracks. In the last step, all pixels of reduced copies are aligned
(Evangelidis and Psarakis, "Parametric image alignment using enhanced correlation coefficient
maximization", 2008). For cross-validation, the image is divided into the black and the white
squares of a chessboard. The correction fitted to the squares of one colour warps those of the
other. The step is kept only if this improves more windows than it worsens.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.images import (
    BLUR_SIGMA_PX,
    MAX_ROUND_TRIP_PX,
    WINDOW_PX,
    downscale,
    equalise,
    erode_mask,
    gaussian_blur,
    local_zncc,
    track_round_trip,
    warp_to_reference,
)
from deepdetect.geometry.transforms import scaled_homography, transform_points

TRACKING_ROUNDS = ((31, 1500, 3), (15, 3000, 1))
"""Each round has a side of the tracked windows in pixels, a maximum number of corners, and a number
of pyramid levels. Corners move farther in the first round. Chosen by hand."""

MIN_TRACKS = 15
"""A homography is fitted only if there are at least this many tracks. Chosen by hand."""

TRACKING_ITERATIONS, TRACKING_STEP_PX = 15, 0.02
"""Maximum number of steps that track a corner. It has converged when a step moves it by less than
the second value. Chosen by hand."""

ALIGNMENT_SIDE_PX, ALIGNMENT_SIGMA_PX, ALIGNMENT_ITERATIONS = 480, 1.0, 15
"""Images are reduced to this longer side and blurred with this sigma before their pixels are
aligned. Chosen by hand."""

IRLS_ITERATIONS = 30
"""Maximum number of reweighting steps. The fit ends earlier if a step changes nothing. Chosen by
hand."""

NOISE_STD = 2.0
"""`normalise_local_contrast` adds the square of this number of grey levels to the variance of each
window, so that noise is not amplified in flat windows. Chosen by hand."""

SQUARES, STEP_PX = 8, WINDOW_PX // 3
"""Number of squares of the chessboard along the longer side of a large image, and distance in
pixels between the centres of the windows in which images are compared. Chosen by hand."""

Fit = Callable[[np.ndarray], "np.ndarray | None"]
"""A function that fits a (3, 3) correction of a homography to the pixels in an (H, W) bool mask. It
returns None if the fit fails."""


def refine_homography(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Refine the homography from the first of two grey images to the second.

    The images are (H, W) uint8, and the homography must be accurate to about ten pixels. The last
    element of the result is 1. If no step improves the homography, only its scale changes.
    """
    size = (gray0.shape[1], gray0.shape[0])
    blurred = gaussian_blur(gray0, BLUR_SIGMA_PX)
    half, inner = _halves(size)

    def correlation(warped: np.ndarray, valid_mask: np.ndarray) -> np.ndarray:
        known = erode_mask(valid_mask, BLUR_SIGMA_PX)
        found = local_zncc(blurred, gaussian_blur(warped, BLUR_SIGMA_PX), known)
        return found[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX][
            : inner.shape[0], : inner.shape[1]
        ]

    equalised = equalise(gray0)
    steps: list[Callable[[np.ndarray, np.ndarray], Fit]] = [
        partial(_fit_to_corners, equalised, *settings) for settings in TRACKING_ROUNDS
    ]
    steps.append(partial(_fit_to_pixels, gray0))
    current = np.asarray(homography, np.float64)
    for step in steps:
        # Tracking needs the detail that cubic interpolation keeps. The last step does not track.
        warp = partial(warp_to_reference, exact=step is steps[-1])
        warped, valid_mask = warp(gray1, current, size)
        fit = step(warped, valid_mask)
        corrections = fit(half), fit(~half)
        views = [warp(gray1, current @ m, size) for m in corrections if m is not None]
        if len(views) < 2:
            continue
        (mixed, mixed_mask), (other, other_mask) = views
        np.copyto(mixed, other, where=half)
        np.copyto(mixed_mask, other_mask, where=half)
        gain = correlation(mixed, mixed_mask) - correlation(warped, valid_mask)
        # The number of windows that improve is compared with the number that get worse. The mean
        # correlation would also rise for a compromise between a plane and objects off the plane.
        gain = gain[inner & np.isfinite(gain)]
        correction = fit(valid_mask) if np.sign(gain).sum() > 0 else None
        if correction is not None:
            current = current @ correction
    return current / current[2, 2]


def _fit_to_corners(
    equalised: np.ndarray,
    window_px: int,
    max_corners: int,
    levels: int,
    warped: np.ndarray,
    valid_mask: np.ndarray,
) -> Fit:
    """Track corners, and return a function that fits a homography to those in a part of the image.

    The fit is by weighted least squares, because RANSAC gives a different result for each random
    sample if no homography fits the whole image, for example due to lens distortion.
    """
    margin = np.ones((window_px, window_px), np.uint8)
    inside = cv2.erode(valid_mask.astype(np.uint8), margin, borderValue=0)
    corners = cv2.goodFeaturesToTrack(equalised, max_corners, 0.001, 5, mask=inside)
    if corners is None:
        return lambda used: None
    start = corners.reshape(-1, 2)
    end, gaps = track_round_trip(
        equalised,
        equalise(warped),
        start,
        window_px,
        levels=levels,
        iterations=TRACKING_ITERATIONS,
        step_px=TRACKING_STEP_PX,
    )
    good = gaps < MAX_ROUND_TRIP_PX
    start, end = start[good], end[good]
    x, y = np.rint(start).astype(np.int64).T

    def least_squares(used: np.ndarray) -> np.ndarray | None:
        chosen = used[y, x]
        if np.count_nonzero(chosen) < MIN_TRACKS:
            return None
        return fit_homography_irls(start[chosen], end[chosen])

    return least_squares


def _fit_to_pixels(gray0: np.ndarray, warped: np.ndarray, valid_mask: np.ndarray) -> Fit:
    (first, scale), (second, _) = (downscale(gray, ALIGNMENT_SIDE_PX) for gray in (gray0, warped))
    blurred = (gaussian_blur(gray, ALIGNMENT_SIGMA_PX) for gray in (first, second))
    normalised = [*map(normalise_local_contrast, blurred)]
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, ALIGNMENT_ITERATIONS, 1e-5)

    def align(used: np.ndarray) -> np.ndarray | None:
        mask = (used & valid_mask).astype(np.uint8)
        mask = cv2.resize(mask, first.shape[::-1], interpolation=cv2.INTER_NEAREST)
        start, kind = np.eye(3, dtype=np.float32), cv2.MOTION_HOMOGRAPHY
        try:
            correction = cv2.findTransformECC(*normalised, start, kind, criteria, mask, 1)[1]
        except cv2.error:  # the alignment does not converge, or there is nothing to correlate
            return None
        return scaled_homography(correction.astype(np.float64), 1 / scale, 1 / scale)

    return align


def fit_homography_irls(
    points0: np.ndarray, points1: np.ndarray, scale_px: float = 1.0
) -> np.ndarray | None:
    """Fit a homography to (N, 2) points by iteratively reweighted least squares (Cauchy weights).

    A point with a residual of `scale_px` pixels has half the weight of a point without residual.
    Returns None if the points determine no homography. The last element of the result is 1.
    """
    middle = points0.mean(axis=0)
    spread = float(np.abs(points0 - middle).mean())
    if not spread > 0:
        return None
    inwards = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, spread]]) / spread
    first, second = ((points - middle) / spread for points in (points0, points1))
    homography = np.eye(3)
    for _ in range(IRLS_ITERATIONS):
        depth = first @ homography[2, :2] + 1
        mapped = transform_points(first, homography)
        gaps = second - mapped
        weight = 1 / (1 + (gaps**2).sum(axis=1) * (spread / scale_px) ** 2)
        position = np.column_stack([first, np.ones(len(first))]) / depth[:, None]
        zeros = np.zeros_like(position)
        across = np.column_stack([position, zeros, -mapped[:, :1] * position[:, :2]])
        down = np.column_stack([zeros, position, -mapped[:, 1:] * position[:, :2]])
        normal = (across.T * weight) @ across + (down.T * weight) @ down
        right = (across.T * weight) @ gaps[:, 0] + (down.T * weight) @ gaps[:, 1]
        try:
            step = np.linalg.solve(normal, right)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        homography = homography + np.append(step, 0).reshape(3, 3)
        if np.abs(step).max() < 1e-9:
            break
    homography = np.linalg.inv(inwards) @ homography @ inwards
    return homography / homography[2, 2]


def normalise_local_contrast(gray: np.ndarray) -> np.ndarray:
    """Subtract each window's mean and divide by its standard deviation; return (H, W) float32."""
    window = (WINDOW_PX, WINDOW_PX)
    values = gray.astype(np.float32)
    mean = cv2.boxFilter(values, cv2.CV_32F, window)
    variance = cv2.boxFilter(values * values, cv2.CV_32F, window) - mean * mean
    return (values - mean) / np.sqrt(np.maximum(variance, 0) + NOISE_STD**2)


def _halves(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Divide an image of (width, height) into the squares of a chessboard.

    Returns two bool masks. The first, (H, W), is True for pixels on squares of one colour. The
    second, (H // STEP_PX, W // STEP_PX), is True for those windows of `local_zncc` that lie within
    one square, with a margin for the blur.
    """
    margin = WINDOW_PX // 2 + int(np.ceil(3 * BLUR_SIGMA_PX))
    side = max(max(size) / SQUARES, 4 * margin)
    row, column = np.ogrid[: size[1], : size[0]]
    half = (column // side + row // side) % 2 == 1
    near = [np.minimum(line % side, side - line % side) for line in (row, column)]
    inner = np.minimum(*near)[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] > margin
    return half, inner[: size[1] // STEP_PX, : size[0] // STEP_PX]
