"""The dominant orientation of the gradients around keypoints (Lowe, 2004, Section 5)."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2
from .._shared.parallel import parallel_for
from .scale_space import SIZE_PER_SIGMA, gaussian_layers, nearest_layers


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
    from .orientation_kernel import BINS, vote

    xy = np.asarray(xy, np.float64).reshape(-1, 2)
    sizes = np.broadcast_to(np.asarray(sizes, np.float64), len(xy))
    angles = np.zeros(len(xy), np.float32)
    if not len(xy):
        return angles
    octaves, layers = nearest_layers(sizes, gray.shape)
    for octave, layer, image in gaussian_layers(gray, int(octaves.min()), int(octaves.max())):
        rows = np.flatnonzero((octaves == octave) & (layers == layer))
        if not len(rows):
            continue
        dx = cv2.filter2D(image, -1, np.array([[-1, 0, 1]], np.float32))
        dy = cv2.filter2D(image, -1, np.array([[-1], [0], [1]], np.float32))
        magnitude, angle = cv2.cartToPolar(dx, dy, angleInDegrees=True)
        bins = np.rint(angle * np.float32(BINS / 360)).astype(np.uint8)
        found = np.empty(len(rows), np.float32)
        places = np.rint(xy[rows] / 2.0**octave).astype(np.int64)
        sigmas = sizes[rows] / SIZE_PER_SIGMA / 2.0**octave
        parallel_for(len(rows), vote, magnitude, bins, places, sigmas, found)
        angles[rows] = found
    return angles
