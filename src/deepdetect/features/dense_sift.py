"""SIFT of very many upright keypoints on whole pixels, all at once (paper, Section III-C).

OpenCV sums the gradients around each keypoint separately. Where all keypoints are upright and of
one size, the sums are a filter: bilinear times Gaussian, along rows and then along columns. The
result equals OpenCV's but for rounding.
"""

from __future__ import annotations

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.parallel import parallel_for
from .keypoints import on_pixels

MIN_SIZE_PX = 2.0
MAX_SIZE_PX = 8.0
"""Diameter of a keypoint."""

SIGMA_PX = 1.6
CAMERA_SIGMA_PX = 0.5
"""Blur of SIFT's first image, and the blur that an image is assumed to have already."""

BIN_WIDTH = 1.5
"""Width of a spatial bin in units of the keypoint's size (3 times its radius)."""


def dense_sift(
    gray: np.ndarray,
    xy: np.ndarray,
    size: float = 3.0,
    step_px: int = 1,
    gradient: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Compute upright SIFT descriptors; they equal OpenCV's at angle 0.

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions on whole pixels within the image.
        size: diameter of the keypoints in pixels, in [2, 8].
        step_px: the positions lie on every so many-th row and column, which saves time.
        gradient: of the image, where `sift_gradient` has computed it already.

    Returns:
        (N, 128) uint8: four rows of four columns of eight orientations.

    Raises:
        MissingExtraError: numba is not installed.
        OptionError: a position is not on a pixel of the image, or the size is out of its range, or
            the positions are not so many rows or columns apart.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (40, 40)).astype(np.uint8)
        >>> dense_sift(gray, np.array([[20, 20], [21, 20]])).shape
        (2, 128)
    """
    if not MIN_SIZE_PX <= size <= MAX_SIZE_PX:
        raise OptionError(
            f"the keypoint size must lie in [{MIN_SIZE_PX:g}, {MAX_SIZE_PX:g}], not {size}"
        )
    if not on_pixels(xy, gray.shape):
        raise OptionError("dense SIFT needs keypoints on whole pixels within the image")
    from .kernels import TILE_COLUMNS, TILE_HEIGHT, describe_tiles

    if not len(xy):
        return np.empty((0, 128), np.uint8)
    pixels = np.asarray(xy).astype(np.int64)
    origin = pixels.min(axis=0)
    if ((pixels - origin) % step_px).any():
        raise OptionError(f"the keypoints do not lie on every {step_px}th row and column")
    column, row = ((pixels - origin) // step_px).T
    rows_of = np.full((row.max() + 1, column.max() + 1), -1, np.int32)
    rows_of[row, column] = np.arange(len(pixels))
    out = np.empty((len(pixels), 128), np.uint8)
    tiles = -(-len(rows_of) // max(1, TILE_HEIGHT // step_px)) * -(
        -rows_of.shape[1] // TILE_COLUMNS
    )
    gradient = sift_gradient(gray) if gradient is None else gradient
    arguments = (*gradient, rows_of, origin, step_px, *_taps(size))
    parallel_for(tiles, describe_tiles, *arguments, out)
    described = rows_of[row, column]
    return out if (described == np.arange(len(out))).all() else out[described]


def sift_gradient(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the gradient of an image that `dense_sift` describes.

    Args:
        gray: (H, W) uint8 luma.

    Returns:
        Its magnitude, 0 on the border, and its orientation in units of 45 degrees, both (H, W)
        float32.
    """
    blur = float(np.sqrt(SIGMA_PX**2 - CAMERA_SIGMA_PX**2))
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), blur)
    across, up = np.zeros_like(smooth), np.zeros_like(smooth)
    across[:, 1:-1] = smooth[:, 2:] - smooth[:, :-2]
    up[1:-1] = smooth[:-2] - smooth[2:]
    magnitude, degrees = cv2.cartToPolar(across, up, angleInDegrees=True)
    return magnitude, degrees * np.float32(8 / 360)


def _taps(size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the pixels around a keypoint, and where they are not 0.

    Returns:
        (4, T) float32 weights for the four spatial bins, and (4, 3) int64 spans, as of
        `describe_tiles`.
    """
    from .kernels import TAPS_AT_ONCE

    width = BIN_WIDTH * size
    reach = int(np.ceil(2.5 * width)) - 1  # bins overlap: half of one beyond four
    offsets = np.arange(-reach, reach + 1) / width
    bins = np.arange(4)[:, None] - 1.5
    bilinear = np.maximum(0, 1 - np.abs(offsets - bins))
    weights = (bilinear * np.exp(-(offsets**2) / 8)).astype(np.float32)
    spans = []
    for row in weights:
        first, last = np.flatnonzero(row)[[0, -1]]
        groups = -(-(last + 1 - first) // TAPS_AT_ONCE)
        spans.append([first, first + groups * TAPS_AT_ONCE, len(offsets)])
    return np.pad(weights, ((0, 0), (0, TAPS_AT_ONCE))), np.array(spans)
