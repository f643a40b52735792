"""SIFT's Gaussian scale space: which of its images belongs to a keypoint of some size."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .._shared.opencv import cv2

LAYERS = 3
"""Of an octave that hold keypoints: from one to the next, sigma grows by the cube root of 2."""

BASE_SIGMA_PX = 1.6
"""Blur of the first image of an octave, in pixels of the octave."""

CAMERA_SIGMA_PX = 0.5
"""Blur that an image is assumed to have."""

SIZE_PER_SIGMA = 2.0
"""OpenCV's keypoints of SIFT have this many times the sigma of their scale as their size."""

MIN_SIDE_PX = 8
"""Octaves with a shorter side are not used."""


def nearest_layers(
    sizes: np.ndarray, shape: tuple[int, ...], first_octave: int = -1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the octave and the layer whose sigma is nearest to that of keypoints.

    Args:
        sizes: (N,) diameters in pixels: twice sigma, as OpenCV's SIFT has them.
        shape: of the image, height and width first.
        first_octave: the lowest; -1 is that of the image at twice its size.

    Returns:
        (N,) int64 octaves, and (N,) int64 layers from 1 to 3.

    Example:
        >>> octaves, layers = nearest_layers(np.array([1.0, 4.0, 8.0]), (480, 640))
        >>> octaves.tolist(), layers.tolist()
        ([-1, 0, 1], [1, 1, 1])
    """
    sigma = np.maximum(np.asarray(sizes, np.float64) / SIZE_PER_SIGMA, 1e-6)
    step = np.rint(LAYERS * np.log2(sigma / BASE_SIGMA_PX)).astype(np.int64)
    last_octave = max(0, int(np.floor(np.log2(max(min(shape[:2]), 1) / MIN_SIDE_PX))))
    step = np.clip(step, LAYERS * first_octave + 1, LAYERS * (last_octave + 1))
    octaves = (step - 1) // LAYERS
    return octaves, step - LAYERS * octaves


def gaussian_layers(
    gray: np.ndarray, first_octave: int, last_octave: int
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the images of the scale space from fine to coarse: octave, layer, (H, W) float32.

    The pixel (x, y) of octave o is at (x, y) 2^o of the image. Layers go from 0 to 3.
    """
    image = gray.astype(np.float32)
    sigma = CAMERA_SIGMA_PX
    if first_octave < 0:
        height, width = image.shape
        double = np.array([[2, 0, 0], [0, 2, 0]], np.float32)
        border = cv2.BORDER_REFLECT_101
        image = cv2.warpAffine(
            image, double, (2 * width, 2 * height), flags=cv2.INTER_LINEAR, borderMode=border
        )
        sigma *= 2
    for octave in range(min(first_octave, 0), last_octave + 1):
        for layer in range(LAYERS + 1):
            wanted = BASE_SIGMA_PX * 2 ** (layer / LAYERS)
            if wanted > sigma:
                image = cv2.GaussianBlur(image, (0, 0), (wanted**2 - sigma**2) ** 0.5)
                sigma = wanted
            yield octave, layer, image
        image = np.ascontiguousarray(image[::2, ::2])
        sigma = BASE_SIGMA_PX
