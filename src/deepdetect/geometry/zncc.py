"""Photometric agreement of two images under a homography: local ZNCC, insensitive to lighting."""

from __future__ import annotations

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2

WINDOW_PX = 15
"""Side of the square windows."""

BLUR_SIGMA_PX = 1.25
"""Of a blur before images are compared: noise and resampling must not count."""

NOISE_STD = 2.0
"""Grey levels that are added to a window's standard deviation, so that noise is not amplified."""

MIN_VARIANCE = 1.0
"""Of a window's grey levels: flatter windows are not compared."""


def warp_to_reference(
    image1: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Warp the second image by the homography from the first to it, into the frame of the first.

    Returns:
        (H, W) or (H, W, 3) uint8 warped image, and its (H, W) bool mask of valid pixels.
    """
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image1, homography, size, flags=flags)
    whole = np.full(image1.shape[:2], 255, np.uint8)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return warped, cv2.warpPerspective(whole, homography, size, flags=nearest) > 0


def local_zncc(
    first: np.ndarray,
    second: np.ndarray,
    valid_mask: np.ndarray,
    window_px: int = WINDOW_PX,
    step_px: int = 1,
) -> np.ndarray:
    """Compute the zero-mean normalised cross-correlation of the windows around each pixel.

    Args:
        first, second: (H, W) images in the same frame, any dtype.
        valid_mask: (H, W) bool; windows must lie within it.
        window_px: side of the square windows in pixels, odd.
        step_px: between the centres of the windows; the side is an odd multiple of it. The image is
            divided into squares of this side from the first pixel on, and the windows are centred
            on them.

    Returns:
        (H // step_px, W // step_px) float32 in [-1, 1], NaN where a window is not valid or is flat.

    Raises:
        OptionError: the side of the windows is no odd multiple of the step.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (32, 32)).astype(np.uint8)
        >>> valid = np.ones((32, 32), bool)
        >>> float(np.nanmedian(local_zncc(image, 255 - image, valid)).round(3))
        -1.0
        >>> local_zncc(image, image, valid, step_px=5).shape
        (6, 6)
    """
    side, rest = divmod(window_px, step_px)
    if rest or side % 2 == 0:
        raise OptionError(f"{window_px} is no odd multiple of {step_px}: choose another window_px")
    shape = (first.shape[0] // step_px, first.shape[1] // step_px)
    if 0 in shape:
        return np.full(shape, np.nan, np.float32)
    a, b, mask = (
        values[: shape[0] * step_px, : shape[1] * step_px] for values in (first, second, valid_mask)
    )
    a, b = a.astype(np.float64), b.astype(np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        if step_px > 1:
            values = cv2.resize(values, shape[::-1], interpolation=cv2.INTER_AREA)
        return cv2.boxFilter(values, cv2.CV_64F, (side, side))

    mean_a, mean_b = mean(a), mean(b)
    variance_a = mean(a * a) - mean_a**2
    variance_b = mean(b * b) - mean_b**2
    whole = mask.astype(np.float32)
    if step_px > 1:
        whole = cv2.resize(whole, shape[::-1], interpolation=cv2.INTER_AREA)
    inside = _erode(whole > 1 - 0.5 / step_px**2, side)
    known = inside & (variance_a > MIN_VARIANCE) & (variance_b > MIN_VARIANCE)
    covariance = mean(a * b) - mean_a * mean_b
    result = np.full(shape, np.nan, np.float32)
    scale = np.sqrt(variance_a[known] * variance_b[known])
    result[known] = np.clip(covariance[known] / scale, -1, 1)
    return result


def median_local_zncc(
    gray0: np.ndarray,
    gray1: np.ndarray,
    homography: np.ndarray,
    blur_sigma_px: float = BLUR_SIGMA_PX,
) -> float:
    """Return the median local ZNCC of two images over their overlap, in [-1, 1].

    Args:
        gray0, gray1: (H, W) uint8 images.
        homography: (3, 3) from the first to the second.
        blur_sigma_px: of a blur of both before, in pixels of the first image.

    Returns:
        The median over the valid windows; -1 when there are none.
    """
    size = (gray0.shape[1], gray0.shape[0])
    warped, valid_mask = warp_to_reference(gray1, homography, size)
    first, second = (gaussian_blur(gray, blur_sigma_px) for gray in (gray0, warped))
    values = local_zncc(first, second, erode_mask(valid_mask, blur_sigma_px))
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else -1.0


def gaussian_blur(gray: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blur an image; returns (H, W) float32."""
    return cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma_px)


def erode_mask(mask: np.ndarray, blur_sigma_px: float) -> np.ndarray:
    """Leave out the pixels that a blur mixes with pixels outside the mask; (H, W) bool."""
    return _erode(mask, 2 * int(np.ceil(3 * blur_sigma_px)) + 1)


def normalise_local_contrast(gray: np.ndarray, window_px: int = WINDOW_PX) -> np.ndarray:
    """Subtract the mean of the window around each pixel and divide by its standard deviation.

    The correlation of two images normalised like this is that of all their windows at once.

    Returns:
        (H, W) float32; near 0 where a window is flat.
    """
    window = (window_px, window_px)
    values = gray.astype(np.float32)
    mean = cv2.boxFilter(values, cv2.CV_32F, window)
    variance = cv2.boxFilter(values * values, cv2.CV_32F, window) - mean * mean
    return (values - mean) / np.sqrt(np.maximum(variance, 0) + NOISE_STD**2)


def _erode(mask: np.ndarray, side: int) -> np.ndarray:
    kernel = np.ones((side, side), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=0) > 0
