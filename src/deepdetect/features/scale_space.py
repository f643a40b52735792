"""SIFT's Gaussian scale space, and the dominant orientations in it (Lowe, 2004, Section 5)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .._shared.opencv import cv2

LAYERS = 3
"""Number of layers of keypoints per octave (Lowe, 2004); each multiplies sigma by 2^(1/3)."""

BASE_SIGMA_PX, CAMERA_SIGMA_PX = 1.6, 0.5
"""BASE_SIGMA_PX is the sigma of an octave's first image, in the octave's pixels. CAMERA_SIGMA_PX is
the sigma of the blur that the camera is assumed to have caused. Both are as in Lowe (2004)."""

SIZE_PER_SIGMA, WINDOW_PER_SIGMA = 2.0, 1.5
"""Size of a SIFT keypoint in OpenCV, and sigma of the Gaussian window for its orientation (Lowe,
2004), both divided by the sigma of the keypoint's scale."""

MIN_SIDE_PX = 8
"""Octaves are not used if a side of their images is shorter than this. Chosen by hand."""


def nearest_layers(sizes: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the octaves and the layers, 1 to 3, whose sigmas are nearest to those of keypoints.

    The (N,) sizes are twice the keypoints' sigmas, as in OpenCV's SIFT. `shape` is the image's
    (height, width). Octave -1 is the image enlarged to twice its size.
    """
    sigma = np.maximum(np.asarray(sizes, np.float64) / SIZE_PER_SIGMA, 1e-6)
    step = np.rint(LAYERS * np.log2(sigma / BASE_SIGMA_PX)).astype(np.int64)
    last_octave = max(0, int(np.floor(np.log2(max(min(shape[:2]), 1) / MIN_SIDE_PX))))
    step = np.clip(step, 1 - LAYERS, LAYERS * (last_octave + 1))
    octaves = (step - 1) // LAYERS
    return octaves, step - LAYERS * octaves


def packed_octaves(sizes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return octaves and layers of (N,) keypoint sizes, packed into (N,) int64 as in OpenCV."""
    octaves, layers = nearest_layers(sizes, shape)
    return (octaves & 255) | (layers << 8)


def gaussian_layers(
    gray: np.ndarray, first_octave: int, last_octave: int
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield the images of the scale space from fine to coarse, as (octave, layer, image).

    Images are (H, W) float32. The pixel (x, y) of octave o lies at (2^o x, 2^o y) in `gray`. Layers
    are numbered from 0 to 3.
    """
    image = gray.astype(np.float32)
    sigma = CAMERA_SIGMA_PX
    if first_octave < 0:
        size = (2 * image.shape[1], 2 * image.shape[0])
        double = np.array([[2, 0, 0], [0, 2, 0]], np.float32)
        image = cv2.warpAffine(image, double, size, borderMode=cv2.BORDER_REFLECT_101)
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


def dominant_angles(gray: np.ndarray, xy: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the dominant orientation of keypoints as in OpenCV's SIFT, (N,) float32.

    The gradients in a Gaussian window of 1.5 sigma around a keypoint, at its scale, vote for 36
    directions. The histogram is smoothed, and a parabola through its highest bin and the two
    neighbouring bins gives the angle. Angles are in degrees, in [0, 360), from the x axis towards
    the y axis, which points down; they are 0 in flat regions. Sizes are diameters, twice sigma.
    Unlike in SIFT, a keypoint gets only one orientation.
    """
    from .kernels import strongest_directions

    xy = np.asarray(xy, np.float64).reshape(-1, 2)
    sizes = np.broadcast_to(np.asarray(sizes, np.float64), len(xy))
    angles = np.zeros(len(xy), np.float32)
    if not len(xy):
        return angles
    octaves, layers = nearest_layers(sizes, gray.shape)
    for octave, layer, image in gaussian_layers(gray, int(octaves.min()), int(octaves.max())):
        rows = np.flatnonzero((octaves == octave) & (layers == layer))
        pixels = np.rint(xy[rows] / 2.0**octave).astype(np.int64)
        windows = WINDOW_PER_SIGMA * sizes[rows] / SIZE_PER_SIGMA / 2.0**octave
        angles[rows] = strongest_directions(image, pixels, windows)
    return angles


def set_angles(
    gray: np.ndarray, xy: np.ndarray, sizes: np.ndarray, angles: np.ndarray | None
) -> np.ndarray:
    """Return (N,) float32 degrees; unset angles (below 0, or None) become the dominant ones."""
    angles = np.full(len(xy), -1, np.float32) if angles is None else angles.copy()
    unset = np.flatnonzero(angles < 0)
    angles[unset] = dominant_angles(gray, xy[unset], sizes[unset])
    return angles
