"""Scale, warp, correlate and track images, and sum values over windows of pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._shared.alpha import continued
from .._shared.opencv import cv2
from .transforms import scaling_matrix

ANTIALIASING_SIGMA = 0.5
"""Sigma of the blur before downscaling, in units of sqrt(1 / scale^2 - 1) px. Chosen by hand."""

WINDOW_PX = 15
BLUR_SIGMA_PX = 1.25
"""`warped_zncc` compares windows of WINDOW_PX after a blur by BLUR_SIGMA_PX. Chosen by hand."""

MAX_UNKNOWN_WEIGHT = 1e-3
"""Maximum total weight of pixels without data in an interpolated pixel. Chosen by hand."""

MIN_VARIANCE = 1.0
"""Windows with a variance of grey levels up to this are too flat to compare. Chosen by hand."""


def downscale(gray: np.ndarray, max_side: int) -> tuple[np.ndarray, float]:
    """Return an image whose longer side is reduced to at most `max_side` pixels, and its scale."""
    scale = min(1.0, max_side / max(gray.shape))
    if scale == 1:
        return gray, 1.0
    # The sides are rounded to whole pixels, but x and y are both sampled at exactly `scale`.
    size = (max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale)))
    smooth = antialiased(gray, scale)
    affine = scaling_matrix(scale)[:2]
    return cv2.warpAffine(smooth, affine, size, borderMode=cv2.BORDER_REPLICATE), scale


def antialiased(image: np.ndarray, scale: float) -> np.ndarray:
    """Blur an image that will be sampled at a scale below 1."""
    return cv2.GaussianBlur(image, (0, 0), ANTIALIASING_SIGMA * np.sqrt(1 / scale**2 - 1))


def warp_to_reference(
    image1: np.ndarray, homography: np.ndarray, size: tuple[int, int], *, exact: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Warp the second image into the frame of the first; `homography` maps the first to the second.

    Returns the warped image of the given (width, height), and the (H, W) bool mask of the pixels
    that show the second image. If `exact`, the interpolation is linear, because OpenCV's cubic
    interpolation shifts detail by up to 0.05 px.
    """
    flags = (cv2.INTER_LINEAR if exact else cv2.INTER_CUBIC) | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image1, homography, size, flags=flags)
    whole = np.full(image1.shape[:2], 255, np.uint8)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return warped, cv2.warpPerspective(whole, homography, size, flags=nearest) > 0


def warp_visible(
    pixels: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Warp RGB or RGBA pixels by `warp_to_reference`; return RGB and a mask of visible pixels."""
    warped, valid = warp_to_reference(continued(pixels), homography, size)
    return without_touched(warped, valid)


def without_touched(warped: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a warped image as RGB, and its mask without pixels mixed with transparent ones."""
    if warped.shape[2] == 3:
        return warped, mask
    known = warped[:, :, 3] >= np.iinfo(warped.dtype).max * (1 - MAX_UNKNOWN_WEIGHT)
    return np.ascontiguousarray(warped[:, :, :3]), mask * known


def warp_bands(
    bands: np.ndarray,
    homography: np.ndarray,
    size: tuple[int, int],
    no_data: float | None = None,
    hidden: np.ndarray | None = None,
) -> np.ndarray:
    """Warp an image of C bands, (H, W, C) of any type of number, as `warp_to_reference` does.

    A pixel has no data if any of its bands is `no_data` or NaN, or if it is `hidden`. Pixels of the
    result that depend on such a pixel, or lie outside the image, become `no_data`. If `no_data` is
    None, they become NaN if the image has NaN, or else 0.
    """
    whole = np.iinfo(bands.dtype) if bands.dtype.kind in "iu" else None
    if whole and no_data is not None and not whole.min <= no_data <= whole.max:
        no_data = None
    absent = np.isnan(bands)
    if no_data is None:
        no_data = np.nan if absent.any() else None
    else:
        absent |= bands == no_data
    known = ~absent.any(axis=2) if hidden is None else ~(absent.any(axis=2) | hidden)
    weight, valid = warp_to_reference(known.astype(np.float32), homography, size)
    if not known.all():
        valid &= np.abs(weight - 1) < MAX_UNKNOWN_WEIGHT
    planes = []
    for band in np.moveaxis(bands, 2, 0):
        warped, _ = warp_to_reference(np.where(known, band, 0).astype(np.float64), homography, size)
        if whole:
            warped = np.rint(warped).clip(whole.min, whole.max)
        planes.append(np.where(valid, warped, no_data or 0).astype(bands.dtype))
    return np.dstack(planes)


def local_zncc(
    first: np.ndarray, second: np.ndarray, valid_mask: np.ndarray, window_px: int = WINDOW_PX
) -> np.ndarray:
    """Compute the zero-mean normalised cross-correlation (ZNCC) of windows at the same positions.

    A window of side `window_px`, an odd number, is centred on each pixel. Returns (H, W) float32 in
    [-1, 1], NaN for windows that are flat (up to `MIN_VARIANCE`) or partly outside `valid_mask`.
    """
    a, b = first.astype(np.float64), second.astype(np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, cv2.CV_64F, (window_px, window_px))

    mean_a, mean_b = mean(a), mean(b)
    variance_a = mean(a * a) - mean_a**2
    variance_b = mean(b * b) - mean_b**2
    known = (
        _erode(valid_mask, window_px) & (variance_a > MIN_VARIANCE) & (variance_b > MIN_VARIANCE)
    )
    covariance = mean(a * b) - mean_a * mean_b
    result = np.full(first.shape, np.nan, np.float32)
    scale = np.sqrt(variance_a[known] * variance_b[known])
    result[known] = np.clip(covariance[known] / scale, -1, 1)
    return result


def warped_zncc(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Warp the second image to the first, and return the `local_zncc` of the two."""
    warped, valid = warp_to_reference(gray1, homography, gray0.shape[::-1])
    first, second = (gaussian_blur(gray, BLUR_SIGMA_PX) for gray in (gray0, warped))
    return local_zncc(first, second, erode_mask(valid, BLUR_SIGMA_PX))


def median_local_zncc(gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray) -> float:
    """Return the median `warped_zncc` of two images over their overlap; -1 if there is none."""
    values = warped_zncc(gray0, gray1, homography)
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else -1.0


def gaussian_blur(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blur an (H, W) image with a Gaussian; return float32."""
    return cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)


def erode_mask(mask: np.ndarray, blur_sigma_px: float) -> np.ndarray:
    """Shrink an (H, W) bool mask by the pixels that a blur mixes with pixels outside the mask."""
    return _erode(mask, 2 * int(np.ceil(3 * blur_sigma_px)) + 1)


def _erode(mask: np.ndarray, side: int) -> np.ndarray:
    kernel = np.ones((side, side), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=0) > 0


def window_sums(
    pixels: np.ndarray,
    values: np.ndarray | np.generic | float,
    shape: Sequence[int],
    window_px: int,
    *,
    at: np.ndarray | None = None,
) -> np.ndarray:
    """Sum the values of sparse pixels over square windows, one sum for each window, (M,).

    `pixels` are (N, 2) int64 (x, y), all different. `values` has one value for each pixel, or is
    one value for all. The image has the shape `shape`, (H, W, ...). The windows are centred at the
    (M, 2) pixels `at`, by default at `pixels`. The sums have the type of the values.
    """
    image = np.zeros(tuple(shape[:2]), np.asarray(values).dtype)
    image[pixels[:, 1], pixels[:, 0]] = values
    window = (window_px, window_px)
    sums = cv2.boxFilter(image, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    x, y = (pixels if at is None else at).T
    return sums[y, x]


MAX_ROUND_TRIP_PX = 0.3
"""A corner is tracked to the second image and back. The track is kept if it ends at less than this
distance from its start. Chosen by hand."""


def track_round_trip(
    first: np.ndarray,
    second: np.ndarray,
    points: np.ndarray,
    window_px: int,
    *,
    levels: int,
    iterations: int = 30,
    step_px: float = 0.01,
    expected: np.ndarray | None = None,
    back_to_start: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Track (N, 2) points from one (H, W) uint8 image to the other and back (Lucas-Kanade).

    The image pyramid has `levels` levels besides the image itself; each doubles the distance that
    a point can move. A track has converged when an iteration moves it by less than `step_px`.

    The search in the second image begins at the (N, 2) positions `expected`, by default at
    `points`. The search back begins at the position just found, minus the expected motion if
    `expected` is given. Without `expected`, it begins at `points` if `back_to_start`.

    Returns (N, 2) float32 positions in the second image, and (N,) distances in pixels between the
    start and the end of each round trip, infinite for lost tracks.
    """
    settings = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, step_px),
    }
    guided = {**settings, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start = np.ascontiguousarray(points, np.float32).reshape(-1, 1, 2)
    if expected is not None:
        guess = np.ascontiguousarray(expected, np.float32).reshape(-1, 1, 2)
        end, forth, _ = cv2.calcOpticalFlowPyrLK(first, second, start, guess.copy(), **guided)
        back_guess = end + start - guess
    else:
        end, forth, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **settings)
        back_guess = start.copy() if back_to_start else None
    returned, back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, end, back_guess, **(settings if back_guess is None else guided)
    )
    gaps = np.linalg.norm((returned - start).reshape(-1, 2), axis=1)
    lost = (forth.ravel() == 0) | (back.ravel() == 0)
    return end.reshape(-1, 2), np.where(lost, np.inf, gaps)


def equalise(gray: np.ndarray) -> np.ndarray:
    """Equalise the contrast locally, so that changes of light are not mistaken for motion."""
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(gray)


EDGE_SIGMA_PX, EDGE_QUANTILE = 1.0, 0.99
"""EDGE_SIGMA_PX is the sigma of the blur before the gradient is computed. Gradient lengths are
scaled so that their quantile EDGE_QUANTILE becomes white (255). Both were chosen by hand."""


def edge_strength(gray: np.ndarray) -> np.ndarray:
    """Return the length of the gradient of an (H, W) uint8 luma image, scaled to uint8.

    The result is the same for inverted tones, so that images of different sensors look alike.
    """
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    length = np.hypot(cv2.Scharr(smooth, -1, 1, 0), cv2.Scharr(smooth, -1, 0, 1))
    white = max(float(np.quantile(length, EDGE_QUANTILE)), 1.0)
    return np.asarray(cv2.convertScaleAbs(length, alpha=255 / white))
