"""Refinement of a homography by the images themselves.

`refine_homography` repeats two kinds of steps on the second image, warped by the current estimate.
One tracks thousands of corners over the few pixels that are left, forth and back (Lucas-Kanade),
and fits a homography to the tracks: blur and foliage need larger windows than sharp walls, so
several sizes are tried in turn. The other uses all pixels: it maximises the correlation of the
images after local contrast normalisation (Evangelidis and Psarakis, "Parametric image alignment
using enhanced correlation coefficient maximization", 2008; OpenCV's). A step is kept only when the
median local ZNCC rises, so by this measure it cannot make things worse.

What uses all pixels is the best compromise. A lens that bends lines, or a wall that is not quite
flat, can make that wrong by a pixel nearly everywhere. `refine_homography_irls` is a robust fit to
tracked corners, which is right on most of the image and further off on the rest; the better of the
two is measured by the fraction of aligned pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from .residuals import transform_points
from .zncc import (
    WINDOW_PX,
    erode_mask,
    gaussian_blur,
    local_zncc,
    median_local_zncc,
    normalise_local_contrast,
    warp_to_reference,
)


@suggest_keywords
@dataclass(frozen=True)
class RefinementOptions:
    """How a homography is refined.

    Attributes:
        max_rounds: each takes one step with every window and every blur.
        max_corners: tracked in each step.
        min_tracks: that a homography is fitted to.
        windows_px: sides of the tracked windows in pixels.
        blur_sigmas_px: of the blur before the steps that use all pixels.
        pyramid_levels: above the image; each doubles how far a track can move.
        tracking_iterations: of each track and level, at most.
        tracking_step_px: a track that moves by less than this has arrived.
        max_round_trip_px: a track counts when it ends this near to its start, forth and back.
        inlier_threshold: of MAGSAC, in pixels.
        ignored_fraction: of the pixels, those that agree least, are ignored by the steps that use
            all pixels: they moved, or are not in the plane.
        min_track_gain: of ZNCC, for a step by tracks that is kept; less is noise.
        min_pixel_gain: the same for a step that uses all pixels, which has less noise.

    Raises:
        OptionError: a value is out of its range.
    """

    max_rounds: int = 4
    max_corners: int = 4000
    min_tracks: int = 30
    windows_px: tuple[int, ...] = (21, 31, 41)
    blur_sigmas_px: tuple[float, ...] = (2.0, 1.0)
    pyramid_levels: int = 3
    tracking_iterations: int = 50
    tracking_step_px: float = 0.005
    max_round_trip_px: float = 0.3
    inlier_threshold: float = 1.0
    ignored_fraction: float = 0.2
    min_track_gain: float = 0.001
    min_pixel_gain: float = 0.0001

    def __post_init__(self) -> None:
        if not self.windows_px or self.max_corners < self.min_tracks:
            raise OptionError("windows_px must not be empty, nor max_corners below min_tracks")
        check_ranges(
            self,
            positive=(
                *("tracking_iterations", "tracking_step_px"),
                *("max_round_trip_px", "inlier_threshold"),
            ),
            not_negative=("pyramid_levels", "min_track_gain", "min_pixel_gain"),
            between={
                "max_rounds": (1, math.inf),
                "min_tracks": (4, math.inf),
                "max_corners": (4, math.inf),
                "windows_px": (5, math.inf),
                "ignored_fraction": (0, 0.99),
            },
        )
        if self.blur_sigmas_px:
            check_ranges(self, positive=("blur_sigmas_px",))


@suggest_keywords
@dataclass(frozen=True)
class IrlsOptions:
    """How a homography is fitted to most of the image.

    Attributes:
        window_px: side of the tracked windows in pixels.
        cauchy_scale_px: a track with this residual has half the weight of an exact one.
        max_iterations: of reweighted least squares.
        max_alignment_error_px: up to which a pixel counts as aligned.
        alignment_window_px: side of the window around a pixel by which its error is measured.
        min_gain: the fit is taken when it aligns this many times as many pixels.

    Raises:
        OptionError: a value is out of its range.
    """

    window_px: int = 31
    cauchy_scale_px: float = 1.0
    max_iterations: int = 30
    max_alignment_error_px: float = 0.5
    alignment_window_px: int = 41
    min_gain: float = 1.1

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("cauchy_scale_px", "max_alignment_error_px"),
            not_negative=("max_iterations", "min_gain"),
            odd=("alignment_window_px",),
            between={"window_px": (5, math.inf)},
        )


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined homography.

    Attributes:
        homography: (3, 3) from the first image to the second, its last element 1.
        zncc: median local ZNCC of the images under it.
        initial_zncc: the same under the initial homography.
        steps: number of steps that were kept.
    """

    homography: np.ndarray
    zncc: float
    initial_zncc: float
    steps: int


def refine_homography(
    gray0: np.ndarray,
    gray1: np.ndarray,
    homography: np.ndarray,
    options: RefinementOptions = RefinementOptions(),
) -> Refinement:
    """Refine a homography by the two images.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        homography: (3, 3) from the first to the second, right within some ten pixels.
        options: how.

    Returns:
        The best homography found; the initial one when no step improved it.
    """
    current = np.asarray(homography, np.float64)
    initial = best = median_local_zncc(gray0, gray1, current)
    steps = [
        *(
            (partial(_track, gray0, window_px=side, options=options), options.min_track_gain)
            for side in options.windows_px
        ),
        *(
            (partial(_align, gray0, sigma_px=sigma, options=options), options.min_pixel_gain)
            for sigma in options.blur_sigmas_px
        ),
    ]
    kept = 0
    for _ in range(options.max_rounds):
        kept_before = kept
        for step, min_gain in steps:
            correction = step(*warp_to_reference(gray1, current, (gray0.shape[1], gray0.shape[0])))
            if correction is None:
                continue
            candidate = current @ correction
            zncc = median_local_zncc(gray0, gray1, candidate)
            if zncc > best + min_gain:
                current, best, kept = candidate, zncc, kept + 1
        if kept == kept_before:
            break
    return Refinement(current / current[2, 2], best, initial, kept)


def _align(
    gray0: np.ndarray,
    warped: np.ndarray,
    valid_mask: np.ndarray,
    *,
    sigma_px: float,
    options: RefinementOptions,
) -> np.ndarray | None:
    """Return the homography from the first image to the warped second one, by all pixels (ECC)."""
    # Blur first, then windows reach over the border.
    inside = erode_mask(erode_mask(valid_mask, sigma_px), WINDOW_PX / 6)
    first, second = (gaussian_blur(gray, sigma_px) for gray in (gray0, warped))
    zncc = local_zncc(first, second, inside)
    if not np.isfinite(zncc).any():
        return None
    inside = zncc > np.nanquantile(zncc, options.ignored_fraction)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    try:
        _, correction = cv2.findTransformECC(
            normalise_local_contrast(first),
            normalise_local_contrast(second),
            np.eye(3, dtype=np.float32),
            cv2.MOTION_HOMOGRAPHY,
            criteria,
            inside.astype(np.uint8),
            1,
        )
    except cv2.error:  # it does not converge, or there is nothing to correlate
        return None
    return correction.astype(np.float64)


def _track(
    gray0: np.ndarray,
    warped: np.ndarray,
    valid_mask: np.ndarray,
    *,
    window_px: int,
    options: RefinementOptions,
) -> np.ndarray | None:
    """Return the homography from the first image to the warped second one, by corners."""
    equalised = equalise(gray0), equalise(warped)
    corners = track_corners(*equalised, valid_mask, window_px, options)
    if corners is None:
        return None
    return cv2.findHomography(
        *corners,
        cv2.USAC_MAGSAC,
        options.inlier_threshold,
        maxIters=5000,
        confidence=0.9999,
    )[0]


def track_corners(
    first: np.ndarray,
    second: np.ndarray,
    valid_mask: np.ndarray,
    window_px: int,
    options: RefinementOptions = RefinementOptions(),
) -> tuple[np.ndarray, np.ndarray] | None:
    """Track corners from one image to another in the same frame, and back.

    Args:
        first, second: (H, W) uint8, after `equalise`.
        valid_mask: (H, W) bool, where the second has content.
        window_px: side of the tracked windows.
        options: of the tracking.

    Returns:
        (N, 2) float32 positions in both; None with fewer than `min_tracks`.
    """
    margin = np.ones((window_px, window_px), np.uint8)
    inside = cv2.erode(valid_mask.astype(np.uint8), margin, borderValue=0)
    corners = cv2.goodFeaturesToTrack(first, options.max_corners, 0.001, 5, mask=inside)
    if corners is None or len(corners) < options.min_tracks:
        return None
    parameters = {
        "winSize": (window_px, window_px),
        "maxLevel": options.pyramid_levels,
        "criteria": (
            cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
            options.tracking_iterations,
            options.tracking_step_px,
        ),
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, **parameters)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, **parameters)
    gap = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (found.ravel() > 0) & (found_back.ravel() > 0) & (gap < options.max_round_trip_px)
    if good.sum() < options.min_tracks:
        return None
    return corners.reshape(-1, 2)[good], there.reshape(-1, 2)[good]


def refine_homography_irls(
    gray0: np.ndarray,
    gray1: np.ndarray,
    homography: np.ndarray,
    options: IrlsOptions = IrlsOptions(),
) -> np.ndarray:
    """Return a homography that aligns clearly more pixels, or the initial one.

    Returns:
        (3, 3), its last element 1.
    """
    size = (gray0.shape[1], gray0.shape[0])
    warped, valid_mask = warp_to_reference(gray1, homography, size)
    equalised = equalise(gray0), equalise(warped)
    corners = track_corners(*equalised, valid_mask, options.window_px)
    if corners is None:
        return homography
    correction = fit_homography_irls(*corners, options)
    if correction is None:
        return homography
    candidate = homography @ correction
    before = aligned_fraction(gray0, warped, valid_mask, options)
    after = aligned_fraction(gray0, *warp_to_reference(gray1, candidate, size), options)
    return candidate / candidate[2, 2] if after > options.min_gain * before else homography


def fit_homography_irls(
    points0: np.ndarray, points1: np.ndarray, options: IrlsOptions = IrlsOptions()
) -> np.ndarray | None:
    """Fit a homography by iteratively reweighted least squares with Cauchy weights.

    Returns:
        (3, 3), its last element 1; None when the points do not determine it.

    Example:
        >>> points = np.array([[0, 0], [9, 0], [9, 9], [0, 9], [4, 5.0]])
        >>> fit_homography_irls(points, points + (2, -1)).round(6)[:2, 2].tolist()
        [2.0, -1.0]
    """
    if len(points0) < 4:
        return None
    middle = points0.mean(axis=0)
    spread = float(np.abs(points0 - middle).mean())
    if not spread > 0:
        return None
    inwards = np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, spread]]) / spread
    first, second = ((points - middle) / spread for points in (points0, points1))
    homography = np.eye(3)
    for _ in range(options.max_iterations):
        depth = first @ homography[2, :2] + 1
        mapped = transform_points(first, homography)
        gaps = second - mapped
        weight = 1 / (1 + (gaps**2).sum(axis=1) * (spread / options.cauchy_scale_px) ** 2)
        place = np.column_stack([first, np.ones(len(first))]) / depth[:, None]
        none = np.zeros_like(place)
        across = np.column_stack([place, none, -mapped[:, :1] * place[:, :2]])
        down = np.column_stack([none, place, -mapped[:, 1:] * place[:, :2]])
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
    found = np.linalg.inv(inwards) @ homography @ inwards
    return found / found[2, 2]


def aligned_fraction(
    gray0: np.ndarray,
    warped: np.ndarray,
    valid_mask: np.ndarray,
    options: IrlsOptions = IrlsOptions(),
) -> float:
    """Return the fraction of the valid pixels that are aligned, in [0, 1].

    The error of a pixel is the length of one Lucas-Kanade step over the window around it, after
    both images are equalised.
    """
    if not valid_mask.any():
        return 0.0
    first, second = (gaussian_blur(equalise(gray), 1) for gray in (gray0, warped))
    x, y = (cv2.Scharr(first, cv2.CV_32F, *order) / 32 for order in ((1, 0), (0, 1)))
    window = (options.alignment_window_px, options.alignment_window_px)
    change = second - first
    change -= cv2.blur(change, window)
    xx, xy, yy, xt, yt = (
        cv2.blur(product, window) for product in (x * x, x * y, y * y, x * change, y * change)
    )
    determinant = xx * yy - xy * xy + 1e-3
    error_px = np.hypot(yy * xt - xy * yt, xx * yt - xy * xt) / determinant
    return float((error_px[valid_mask] <= options.max_alignment_error_px).mean())


def equalise(gray: np.ndarray) -> np.ndarray:
    """Equalise an image locally, so that changes of light are not taken for motion."""
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(gray)
