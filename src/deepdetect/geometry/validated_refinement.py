"""Refinement of a homography in a fraction of a second, each step of it cross-validated.

Steps as in `homography_refinement`, but few: corners are tracked over the pixels that are left
between the first image and the warped second one, forth and back, and a homography is fitted to
them; then all pixels of a smaller copy are aligned. The image is divided into squares, which belong
to a few parts in turn. A step is kept only if, on each part, what it finds *without* that part
correlates the images better than the homography before: where it holds on what it was not fitted
to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from .homography_refinement import (
    IrlsOptions,
    RefinementOptions,
    equalise,
    fit_homography_irls,
    track_corners,
)
from .rescaling import downscale, scaled_homography
from .zncc import (
    WINDOW_PX,
    erode_mask,
    gaussian_blur,
    local_zncc,
    normalise_local_contrast,
    warp_to_reference,
)

STEP_PX = WINDOW_PX // 3
"""Between the windows in which images are compared."""

Fit = Callable[[np.ndarray], "np.ndarray | None"]
"""From the (H, W) bool mask of the pixels that may be used to a correction, (3, 3)."""


@suggest_keywords
@dataclass(frozen=True)
class ValidatedRefinementOptions:
    """How a homography is refined, and when a step is kept.

    Attributes:
        windows_px: sides of the tracked windows, odd, one for each round of tracking and fitting.
        max_corners: tracked in each round; in the first one, which starts the furthest off, half as
            many.
        min_tracks: that a homography is fitted to.
        pyramid_levels: above the image; each doubles how far a track can move. After the first
            round one is enough.
        tracking_iterations: of each track and level, at most.
        tracking_step_px: a track that moves by less than this has arrived.
        max_round_trip_px: a track counts when it ends this near to its start, forth and back.
        cauchy_scale_px: a track with this residual has half the weight of an exact one.
        alignment_side_px: longer side of the copies on which all pixels are aligned, where the
            images are larger.
        alignment_sigma_px: of the blur of these copies.
        alignment_iterations: at most.
        parts: of the cross-validation.
        squares: along the longer side of the image.
        blur_sigma_px: of the blur before images are compared: noise must not count.
        min_gain: a step is kept if the local ZNCC rises on more windows than it falls on, of those
            not fitted to, by at least this fraction of them.

    Raises:
        OptionError: a value is out of its range.
    """

    windows_px: tuple[int, ...] = (31, 15)
    max_corners: int = 3000
    min_tracks: int = 15
    pyramid_levels: int = 3
    tracking_iterations: int = 15
    tracking_step_px: float = 0.02
    max_round_trip_px: float = 0.3
    cauchy_scale_px: float = 1.0
    alignment_side_px: int = 480
    alignment_sigma_px: float = 1.0
    alignment_iterations: int = 15
    parts: int = 2
    squares: int = 8
    blur_sigma_px: float = 1.25
    min_gain: float = 0.0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=(
                *("max_corners", "squares", "blur_sigma_px", "alignment_sigma_px"),
                *("max_round_trip_px", "cauchy_scale_px"),
                *("tracking_iterations", "tracking_step_px"),
                *("alignment_side_px", "alignment_iterations"),
            ),
            not_negative=("pyramid_levels", "min_gain"),
            odd=("windows_px",),
            between={"min_tracks": (4, math.inf), "parts": (2, 16)},
        )

    def tracking(self, window_px: int) -> RefinementOptions:
        """Return the options of `track_corners` for one of the windows."""
        first = window_px == self.windows_px[0]
        return RefinementOptions(
            max_corners=max(self.max_corners // 2 if first else self.max_corners, self.min_tracks),
            min_tracks=self.min_tracks,
            pyramid_levels=self.pyramid_levels if first else min(1, self.pyramid_levels),
            tracking_iterations=self.tracking_iterations,
            tracking_step_px=self.tracking_step_px,
            max_round_trip_px=self.max_round_trip_px,
        )


def refine_homography_validated(
    gray0: np.ndarray,
    gray1: np.ndarray,
    homography: np.ndarray,
    options: ValidatedRefinementOptions = ValidatedRefinementOptions(),
) -> np.ndarray:
    """Refine a homography, keeping what holds on parts of the image that it was not fitted to.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        homography: (3, 3) from the first to the second, right within some ten pixels.
        options: how.

    Returns:
        (3, 3), its last element 1; the initial one where nothing better was found.

    Example:
        >>> scene = np.random.default_rng(0).integers(0, 256, (40, 40)).astype(np.uint8)
        >>> scene = cv2.resize(scene, (240, 240), interpolation=cv2.INTER_CUBIC)
        >>> start = np.array([[1, 0, -12], [0, 1, 1], [0, 0, 1.0]])
        >>> found = refine_homography_validated(scene[:, :200], scene[:, 10:210], start)
        >>> bool(np.abs(found[:2, 2] - (-10, 0)).max() < 0.1)
        True
    """
    size = (gray0.shape[1], gray0.shape[0])
    first = gaussian_blur(gray0, options.blur_sigma_px)
    part, inner = _parts(size, options)

    def correlation(warped: np.ndarray, valid_mask: np.ndarray) -> np.ndarray:
        second = gaussian_blur(warped, options.blur_sigma_px)
        known = erode_mask(valid_mask, options.blur_sigma_px)
        return local_zncc(first, second, known, step_px=STEP_PX)

    def gain(fit: Fit) -> float:
        """Return on how many more windows a fit is better than worse, as a fraction of them.

        Not the mean: a compromise between a plane and what lies off it raises that, too.
        """
        fits = [fit(part != one) for one in range(options.parts)]
        views = [warp_to_reference(gray1, current @ one, size) for one in fits if one is not None]
        if len(views) < options.parts:
            return -math.inf
        mixed, valid_mask = views[0]
        for one, (warped, valid) in enumerate(views[1:], start=1):
            np.copyto(mixed, warped, where=part == one)
            np.copyto(valid_mask, valid, where=part == one)
        after = correlation(mixed, valid_mask)
        known = inner & np.isfinite(before) & np.isfinite(after)
        if not known.any():
            return -math.inf
        return float(np.sign((after - before)[known]).mean())

    current = np.asarray(homography, np.float64)
    warped, valid_mask = warp_to_reference(gray1, current, size)
    before = correlation(warped, valid_mask)
    steps = list(_steps(gray0, options))
    for step in steps:
        fit = step(warped, valid_mask)
        correction = fit(valid_mask) if fit and gain(fit) > options.min_gain else None
        if correction is None:
            continue
        current = current @ correction
        if step is steps[-1]:  # nothing is compared with it any more
            break
        warped, valid_mask = warp_to_reference(gray1, current, size)
        before = correlation(warped, valid_mask)
    return current / current[2, 2]


Step = Callable[[np.ndarray, np.ndarray], "Fit | None"]
"""From the warped second image and its (H, W) bool mask of valid pixels to a way to fit."""


def _steps(gray0: np.ndarray, options: ValidatedRefinementOptions) -> Iterator[Step]:
    equalised = equalise(gray0)
    for window_px in options.windows_px:
        yield partial(_fit_to_corners, equalised, window_px=window_px, options=options)
    yield partial(_fit_to_pixels, gray0, options=options)


def _fit_to_corners(
    equalised: np.ndarray,
    warped: np.ndarray,
    valid_mask: np.ndarray,
    *,
    window_px: int,
    options: ValidatedRefinementOptions,
) -> Fit | None:
    """Track corners, and return the fit to those in a part of the image.

    Least squares with weights: right on most of an image that no single homography fits (a lens
    that bends lines, a wall that is not quite flat), where a consensus is another one each time.
    """
    tracking = options.tracking(window_px)
    tracks = track_corners(equalised, equalise(warped), valid_mask, window_px, tracking)
    if tracks is None:
        return None
    start, end = tracks
    x, y = np.rint(start).astype(np.int64).T
    weighted = IrlsOptions(cauchy_scale_px=options.cauchy_scale_px)

    def least_squares(used: np.ndarray) -> np.ndarray | None:
        chosen = used[y, x]
        if np.count_nonzero(chosen) < options.min_tracks:
            return None
        return fit_homography_irls(start[chosen], end[chosen], weighted)

    return least_squares


def _fit_to_pixels(
    gray0: np.ndarray,
    warped: np.ndarray,
    valid_mask: np.ndarray,
    *,
    options: ValidatedRefinementOptions,
) -> Fit:
    """Return the alignment of all pixels (ECC), which has the least noise."""
    side = options.alignment_side_px
    (first, scale), (second, _) = downscale(gray0, side), downscale(warped, side)
    shape = first.shape[::-1]
    normalised = [
        normalise_local_contrast(gaussian_blur(gray, options.alignment_sigma_px))
        for gray in (first, second)
    ]
    criteria = (
        cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT,
        options.alignment_iterations,
        1e-5,
    )

    def align(used: np.ndarray) -> np.ndarray | None:
        mask = cv2.resize(
            (used & valid_mask).astype(np.uint8), shape, interpolation=cv2.INTER_NEAREST
        )
        try:
            found = cv2.findTransformECC(
                *normalised, np.eye(3, dtype=np.float32), cv2.MOTION_HOMOGRAPHY, criteria, mask, 1
            )[1]
        except cv2.error:  # it does not converge, or there is nothing to correlate
            return None
        return scaled_homography(found.astype(np.float64), 1 / scale, 1 / scale)

    return align


def _parts(
    size: tuple[int, int], options: ValidatedRefinementOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Divide an image into squares, in turn of each part.

    Returns:
        Which part each pixel belongs to, (H, W) int64, and whether the blurred windows of
        `local_zncc` lie within their squares, (H // STEP_PX, W // STEP_PX) bool.
    """
    margin = WINDOW_PX // 2 + int(np.ceil(3 * options.blur_sigma_px))
    side = max(max(size) / options.squares, 4 * margin)
    row, column = np.ogrid[: size[1], : size[0]]
    along = column // side + row // side * (options.parts // 2 + options.parts % 2)
    part = (along % options.parts).astype(np.int64)
    near = [np.minimum(line % side, side - line % side) for line in (row, column)]
    inner = np.minimum(*near)[STEP_PX // 2 :: STEP_PX, STEP_PX // 2 :: STEP_PX] > margin
    return part, inner[: size[1] // STEP_PX, : size[0] // STEP_PX]
