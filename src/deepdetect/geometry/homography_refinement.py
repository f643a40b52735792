"""Sharpening a homography by the images themselves: Lucas-Kanade on the warped image, then ECC.

Each step warps the second image back by what is known. Some track thousands of corners over the
few pixels that are left, there and back, and fit a homography to the tracks: blur and foliage want
larger windows than sharp walls, so several are tried in turn. The others take all pixels at once:
they raise the correlation of the locally normalised images (Evangelidis and Psarakis, "Parametric
image alignment using enhanced correlation coefficient maximization", 2008; OpenCV's). A step is
kept only when the images then correlate better, so it cannot make things worse by that measure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from .._shared.errors import OptionError
from .residuals import transform_points
from .zncc import (
    WINDOW,
    erode_mask,
    gaussian_blur,
    local_zncc,
    median_local_zncc,
    normalise_local_contrast,
    warp_to_reference,
)

FEWEST = 30
"""Tracks that a homography is fitted to, at least."""


LEFT_OUT = 0.2
"""Share of the pixels, those that are least alike, that has no say: what moved or is not plane."""

LEAST_GAIN = 0.001
"""Of correlation, by a step by corners that is kept: less is noise, and moves the borders about."""

LEAST_GAIN_OF_ALL = 0.0001
"""The same by a step that takes all pixels, which has less noise."""

IN_PLACE = 0.5
"""A pixel is in place when what is around it lies at most so far off, in pixels."""

MORE = 1.1
"""The fit to the majority is taken when it puts so many times as many pixels in place."""

TRACK_WINDOW = 31
"""Side of the tracked windows in pixels."""

SURROUNDINGS = 41
"""Side in pixels of the window around a pixel that says how far off it lies."""

SCALE = 1.0
"""Of Cauchy's weights in pixels: corners so far off have half the say."""

IRLS_ROUNDS = 30


@dataclass(frozen=True)
class RefinementOptions:
    """How a homography is refined.

    Attributes:
        rounds: at the most; each takes one step with every window.
        corners: tracked in each step.
        windows: sides of the tracked windows in pixels.
        blurs: sigmas of the blur in pixels before the steps that take all pixels.
        levels: of the pyramid above the image; each doubles what a track can move.
        round_trip: a track counts when there and back it ends so near, in pixels.
        inlier_threshold: of MAGSAC, in pixels.
        seed: of its random samples.

    Raises:
        OptionError: a value is out of its range.
    """

    rounds: int = 4
    corners: int = 4000
    windows: tuple[int, ...] = (21, 31, 41)
    blurs: tuple[float, ...] = (2.0, 1.0)
    levels: int = 3
    round_trip: float = 0.3
    inlier_threshold: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.rounds < 1 or self.corners < FEWEST or self.levels < 0:
            raise OptionError(f"a refinement needs a round and {FEWEST} corners at least")
        if not self.windows or min(self.windows) < 5:
            raise OptionError("a refinement needs windows of 5 pixels at least")
        if self.blurs and min(self.blurs) <= 0:
            raise OptionError("the blurs of a refinement must be above 0 pixels")
        if not (self.round_trip > 0 and self.inlier_threshold > 0):
            raise OptionError("the distances of a refinement must be above 0 pixels")


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined homography.

    Attributes:
        homography: (3, 3) from the first image to the second, its last element 1.
        zncc: median local ZNCC of the images under it.
        initial_zncc: the same under the homography that it began with.
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
        The best homography found; the one given when no step made it better.
    """
    current = np.asarray(homography, np.float64)
    before = best = median_local_zncc(gray0, gray1, current)
    track = [partial(_track, gray0, window=side, options=options) for side in options.windows]
    align = [partial(_align, gray0, blur=blur) for blur in options.blurs]
    steps = [
        *((step, LEAST_GAIN) for step in track),
        *((step, LEAST_GAIN_OF_ALL) for step in align),
    ]
    kept = 0
    for _ in range(options.rounds):
        kept_before = kept
        for step, least_gain in steps:
            correction = step(*warp_to_reference(gray1, current, (gray0.shape[1], gray0.shape[0])))
            if correction is None:
                continue
            candidate = current @ correction
            reached = median_local_zncc(gray0, gray1, candidate)
            if reached > best + least_gain:
                current, best, kept = candidate, reached, kept + 1
        if kept == kept_before:
            break
    return Refinement(current / current[2, 2], best, before, kept)


def _align(
    gray0: np.ndarray, warped: np.ndarray, seen: np.ndarray, *, blur: float
) -> np.ndarray | None:
    """Return the homography from the first image to the warped second one, by all pixels."""
    # Blur first, then windows reach over the border.
    inside = erode_mask(erode_mask(seen, blur), WINDOW / 6)
    images = [gaussian_blur(gray, blur) for gray in (gray0, warped)]
    alike = local_zncc(*images, inside)
    if not np.isfinite(alike).any():
        return None
    inside = alike > np.nanquantile(alike, LEFT_OUT)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    start = np.eye(3, dtype=np.float32)
    try:
        _, correction = cv2.findTransformECC(
            *map(normalise_local_contrast, images),
            start,
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
    seen: np.ndarray,
    *,
    window: int,
    options: RefinementOptions,
) -> np.ndarray | None:
    """Return the homography from the first image to the warped second one, by corners."""
    corners = tracked_corners(gray0, warped, seen, window, options)
    if corners is None:
        return None
    cv2.setRNGSeed(options.seed)
    correction, _ = cv2.findHomography(
        *corners,
        cv2.USAC_MAGSAC,
        options.inlier_threshold,
        maxIters=5000,
        confidence=0.9999,
    )
    return correction


def tracked_corners(
    gray0: np.ndarray,
    warped: np.ndarray,
    seen: np.ndarray,
    window: int,
    options: RefinementOptions,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Track corners from the first image to the warped second one and back.

    Args:
        gray0: (H, W) uint8.
        warped: (H, W) uint8, the second image in the frame of the first.
        seen: (H, W) bool, where that has content.
        window: side of the tracked windows in pixels.
        options: number of corners, levels of the pyramid and round trip.

    Returns:
        (N, 2) float32 positions in both; None with fewer than `FEWEST`.
    """
    # Equalised, so that light and shade do not pass for motion.
    equalise = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply
    first, second = equalise(gray0), equalise(warped)
    margin = np.ones((window, window), np.uint8)
    inside = cv2.erode(seen.astype(np.uint8), margin, borderValue=0)
    corners = cv2.goodFeaturesToTrack(first, options.corners, 0.001, 5, mask=inside)
    if corners is None or len(corners) < FEWEST:
        return None
    parameters = {
        "winSize": (window, window),
        "maxLevel": options.levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 0.005),
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, **parameters)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, **parameters)
    gap = np.linalg.norm((back - corners).reshape(-1, 2), axis=1)
    good = (found.ravel() > 0) & (found_back.ravel() > 0) & (gap < options.round_trip)
    if good.sum() < FEWEST:
        return None
    return corners.reshape(-1, 2)[good], there.reshape(-1, 2)[good]


def refine_homography_irls(
    gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray
) -> np.ndarray:
    """Return the homography given, or one that puts clearly more pixels in place.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        homography: (3, 3) from the first image to the second, right within some pixels.

    Returns:
        (3, 3), its last element 1.
    """
    size = (gray0.shape[1], gray0.shape[0])
    warped, seen = warp_to_reference(gray1, homography, size)
    corners = tracked_corners(gray0, warped, seen, TRACK_WINDOW, RefinementOptions())
    if corners is None:
        return homography
    correction = fit_homography_irls(*corners)
    if correction is None:
        return homography
    candidate = homography @ correction
    before = aligned_fraction(gray0, warped, seen)
    after = aligned_fraction(gray0, *warp_to_reference(gray1, candidate, size))
    return candidate / candidate[2, 2] if after > MORE * before else homography


def fit_homography_irls(points0: np.ndarray, points1: np.ndarray) -> np.ndarray | None:
    """Fit a homography by iteratively reweighted least squares with Cauchy's weights.

    Args:
        points0, points1: (N, 2), most of them at most some pixels from where they were.

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
    for _ in range(IRLS_ROUNDS):
        depth = first @ homography[2, :2] + 1
        mapped = transform_points(first, homography)
        gaps = second - mapped
        weight = 1 / (1 + (gaps**2).sum(axis=1) * (spread / SCALE) ** 2)
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


def aligned_fraction(gray0: np.ndarray, warped: np.ndarray, seen: np.ndarray) -> float:
    """Return the share of the seen pixels that lie at most `IN_PLACE` px off.

    How far is one step of Lucas-Kanade's at each pixel, over a window, after both images are
    equalised.

    Args:
        gray0, warped: (H, W) uint8.
        seen: (H, W) bool, where the second has content.
    """
    if not seen.any():
        return 0.0
    equalise = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply
    first, second = (
        cv2.GaussianBlur(equalise(gray).astype(np.float32), (0, 0), 1) for gray in (gray0, warped)
    )
    x, y = (cv2.Scharr(first, cv2.CV_32F, *order) / 32 for order in ((1, 0), (0, 1)))
    window = (SURROUNDINGS, SURROUNDINGS)
    change = second - first
    change -= cv2.blur(change, window)
    xx, xy, yy, xt, yt = (
        cv2.blur(product, window) for product in (x * x, x * y, y * y, x * change, y * change)
    )
    determinant = xx * yy - xy * xy + 1e-3
    off = np.hypot(yy * xt - xy * yt, xx * yt - xy * xt) / determinant
    return float((off[seen] <= IN_PLACE).mean())
