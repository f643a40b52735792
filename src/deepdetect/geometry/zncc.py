"""How alike two images look under a homography: local correlation, blind to light."""

from __future__ import annotations

import cv2
import numpy as np

WINDOW = 15
SMOOTHING = 1.25
"""Pixels (sigma) of blur before images are compared: noise and resampling are not what counts."""

NOISE = 2.0
"""Grey levels that are added to the spread of a window, so that noise is not blown up."""

FLAT = 1.0
"""Grey levels; where both windows vary less than that there is nothing to compare."""


def warp_to_reference(
    gray1: np.ndarray, homography: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Show the second image in the frame of the first.

    Args:
        gray1: (H1, W1) uint8, the second image.
        homography: (3, 3) from the first image to the second.
        size: (width, height) of the first image.

    Returns:
        (H, W) uint8 warped image, and (H, W) bool where it has content.
    """
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(gray1, homography, size, flags=flags)
    whole = np.full(gray1.shape, 255, np.uint8)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return warped, cv2.warpPerspective(whole, homography, size, flags=nearest) > 0


def local_zncc(
    first: np.ndarray, second: np.ndarray, valid: np.ndarray, window: int = WINDOW
) -> np.ndarray:
    """Compute the zero-mean correlation of the windows around each pixel.

    Args:
        first, second: (H, W) images in the same frame, any dtype.
        valid: (H, W) bool; windows that reach beyond it do not count.
        window: side of the square windows in pixels, odd.

    Returns:
        (H, W) float32 in [-1, 1], NaN where a window does not count or is flat.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (32, 32)).astype(np.uint8)
        >>> seen = np.ones((32, 32), bool)
        >>> float(np.nanmedian(local_zncc(image, 255 - image, seen)).round(3))
        -1.0
    """
    a, b = first.astype(np.float64), second.astype(np.float64)

    def mean(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, cv2.CV_64F, (window, window))

    mean_a, mean_b = mean(a), mean(b)
    variance_a = mean(a * a) - mean_a**2
    variance_b = mean(b * b) - mean_b**2
    kernel = np.ones((window, window), np.uint8)
    inside = cv2.erode(valid.astype(np.uint8), kernel, borderValue=0) > 0
    known = inside & (variance_a > FLAT) & (variance_b > FLAT)
    covariance = mean(a * b) - mean_a * mean_b
    result = np.full(first.shape, np.nan, np.float32)
    spread = np.sqrt(variance_a[known] * variance_b[known])
    result[known] = np.clip(covariance[known] / spread, -1, 1)
    return result


def median_local_zncc(
    gray0: np.ndarray, gray1: np.ndarray, homography: np.ndarray, smoothing: float = SMOOTHING
) -> float:
    """Return the median correlation of two images over their overlap, in [-1, 1].

    Args:
        gray0, gray1: (H, W) uint8 images.
        homography: (3, 3) from the first to the second.
        smoothing: sigma of a blur before, in pixels of the first image.

    Returns:
        The median over the windows that count; -1 when there are none.
    """
    size = (gray0.shape[1], gray0.shape[0])
    warped, seen = warp_to_reference(gray1, homography, size)
    first, second = (gaussian_blur(gray, smoothing) for gray in (gray0, warped))
    values = local_zncc(first, second, erode_mask(seen, smoothing))
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else -1.0


def gaussian_blur(gray: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image; returns (H, W) float32."""
    return cv2.GaussianBlur(gray.astype(np.float32), (0, 0), sigma)


def erode_mask(valid: np.ndarray, sigma: float) -> np.ndarray:
    """Leave out the pixels that a blur of this sigma mixes with what is not valid; (H, W) bool."""
    reach = 2 * int(np.ceil(3 * sigma)) + 1
    kernel = np.ones((reach, reach), np.uint8)
    return cv2.erode(valid.astype(np.uint8), kernel, borderValue=0) > 0


def normalise_local_contrast(gray: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Take away the mean of the window around each pixel and divide by its spread.

    The correlation of two images made so is that of all their windows at once.

    Args:
        gray: (H, W), any dtype.
        window: side of the square windows in pixels, odd.

    Returns:
        (H, W) float32; near 0 where a window is flat.
    """
    values = gray.astype(np.float32)
    mean = cv2.boxFilter(values, cv2.CV_32F, (window, window))
    variance = cv2.boxFilter(values * values, cv2.CV_32F, (window, window)) - mean * mean
    return (values - mean) / np.sqrt(np.maximum(variance, 0) + NOISE**2)
