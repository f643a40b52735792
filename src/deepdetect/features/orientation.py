"""The dominant orientation of the gradients around keypoints (Lowe, 2004, Section 5)."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2
from .scale_space import SIZE_PER_SIGMA, gaussian_layers, nearest_layers

BINS = 36
WINDOW_PER_SIGMA = 1.5
"""Sigma of the Gaussian window over that of the keypoint."""

RADIUS_PER_WINDOW = 3.0

SAMPLES_AT_ONCE = 1 << 16
"""Gradients that are voted with at a time, so that they stay in the processor's cache."""


def dominant_angles(gray: np.ndarray, xy: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the dominant orientation of keypoints, as OpenCV's SIFT assigns it.

    The gradients in a Gaussian window of 1.5 sigma around a keypoint, at the scale of the
    keypoint, vote for 36 directions; the histogram is smoothed, and a parabola through its highest
    bin and the two beside it gives the angle. SIFT has more than one keypoint where other
    directions have nearly as many votes; here it is always the highest.

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        sizes: (N,) diameters in pixels: twice sigma, as of OpenCV's keypoints of SIFT.

    Returns:
        (N,) float32 in [0, 360): degrees from x towards y, which points down, as
        `cv2.KeyPoint.angle`. 0 where the image is flat.

    Example:
        >>> gray = np.tile(np.arange(64, dtype=np.uint8), (64, 1))  # brighter to the right
        >>> dominant_angles(gray, np.array([[32, 32]]), np.array([6])).tolist()
        [0.0]
        >>> dominant_angles(gray.T, np.array([[32, 32]]), np.array([6])).tolist()
        [90.0]
    """
    xy = np.asarray(xy, np.float64).reshape(-1, 2)
    sizes = np.broadcast_to(np.asarray(sizes, np.float64), len(xy))
    angles = np.zeros(len(xy), np.float32)
    if not len(xy):
        return angles
    octaves, layers = nearest_layers(sizes, gray.shape)
    for octave, layer, image in gaussian_layers(gray, int(octaves.min()), int(octaves.max())):
        rows = np.flatnonzero((octaves == octave) & (layers == layer))
        places = np.rint(xy[rows] / 2.0**octave).astype(np.int64)
        windows = WINDOW_PER_SIGMA * sizes[rows] / SIZE_PER_SIGMA / 2.0**octave
        radii = np.rint(RADIUS_PER_WINDOW * windows).astype(np.int64)
        for radius in np.unique(radii).tolist():
            alike = np.flatnonzero(radii == radius)
            step = max(1, SAMPLES_AT_ONCE // (2 * radius + 1) ** 2)
            for first in range(0, len(alike), step):
                some = alike[first : first + step]
                votes = _votes(image, places[some], windows[some], radius)
                angles[rows[some]] = _highest(votes)
    return angles


def _votes(image: np.ndarray, places: np.ndarray, windows: np.ndarray, radius: int) -> np.ndarray:
    """Return (N, 36) histograms of the gradients around pixels of an image.

    Args:
        image: (H, W) float32.
        places: (N, 2) pixels.
        windows: (N,) sigmas of the Gaussian windows in pixels.
        radius: half the side of the windows in pixels.
    """
    height, width = image.shape
    offsets = np.arange(-radius, radius + 1)
    weights = np.exp(-0.5 * (offsets / windows[:, None]) ** 2)
    x, y = (places[:, axis, None] + offsets for axis in (0, 1))
    # The outermost pixels have no gradient.
    across = np.where((x >= 1) & (x < width - 1), weights, 0)
    down = np.where((y >= 1) & (y < height - 1), weights, 0)
    x, y = np.clip(x, 1, width - 2), np.clip(y, 1, height - 2)
    pixels = (y * width)[:, :, None] + x[:, None]
    flat = image.reshape(-1)
    dx = (flat.take(pixels + 1) - flat.take(pixels - 1)).reshape(len(places), -1)
    dy = (flat.take(pixels + width) - flat.take(pixels - width)).reshape(len(places), -1)
    magnitude, angle = cv2.cartToPolar(dx, dy, angleInDegrees=True)
    bins = np.rint(angle * np.float32(BINS / 360)).astype(np.intp) % BINS
    bins += BINS * np.arange(len(places))[:, None]
    values = (down[:, :, None] * across[:, None]).reshape(magnitude.shape) * magnitude
    votes = np.bincount(bins.reshape(-1), values.reshape(-1), BINS * len(places))
    return votes.reshape(len(places), BINS)


def _highest(votes: np.ndarray) -> np.ndarray:
    """Return the directions of the highest bins of smoothed histograms, (N,) float32 degrees."""
    near = np.roll(votes, 1, 1) + np.roll(votes, -1, 1)
    far = np.roll(votes, 2, 1) + np.roll(votes, -2, 1)
    smooth = (6 * votes + 4 * near + far) / 16
    every, best = np.arange(len(votes)), smooth.argmax(1)
    left, middle, right = (smooth[every, (best + step) % BINS] for step in (-1, 0, 1))
    curvature = left - 2 * middle + right
    peaked = curvature < 0
    shift = np.where(peaked, (left - right) / np.where(peaked, 2 * curvature, 1), 0)
    degrees = ((best + shift) * (360 / BINS)).astype(np.float32)
    degrees[degrees < 0] += 360
    degrees[degrees >= 360] = 0
    return degrees
