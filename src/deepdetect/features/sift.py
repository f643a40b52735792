"""SIFT and RootSIFT descriptors of any keypoints (DeepDetect paper, Section III-C).

To add a descriptor, add to `DESCRIPTORS` a function `(gray, xy, size, angle) -> (N, D) array`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from .._shared.errors import ImageError, OptionError
from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .keypoints import Keypoints, on_pixels
from .scale_space import BASE_SIGMA_PX, CAMERA_SIGMA_PX, LAYERS, packed_octaves, set_angles

ROOT_SIFT: Final = "rootsift"
"""Value of `Keypoints.descriptor_type` for RootSIFT."""

DENSE_SIZES_PX, MIN_DENSE_DENSITY = (2.0, 8.0), 0.02
"""`dense_sift` supports keypoint diameters in the range DENSE_SIZES_PX. Above MIN_DENSE_DENSITY
keypoints per pixel, it is faster than describing keypoints one by one."""

BIN_WIDTH = 1.5
"""Width of a spatial bin in units of the keypoint's diameter, as in OpenCV."""

ROWS_AT_ONCE = 1024
"""This many descriptors are converted to RootSIFT at a time, to stay in the processor's cache."""


def sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute (N, 128) uint8 SIFT descriptors, by the fastest implementation for these keypoints.

    Many upright keypoints on whole pixels are described by `dense_sift`, whose result differs from
    OpenCV's by 1 in one of ten thousand numbers. Other keypoints are described by OpenCV. The size
    is a diameter in pixels, the angle is in degrees. The angle -1 usually means unset, but OpenCV's
    SIFT reads it as a rotation by one degree, as in the DeepDetect paper's code.
    """
    dense = len(xy) > MIN_DENSE_DENSITY * gray.size
    upright = angle == 0 and DENSE_SIZES_PX[0] <= size <= DENSE_SIZES_PX[1]
    if dense and upright and on_pixels(xy, gray.shape):
        return dense_sift(gray, xy, size)
    return opencv_sift_descriptors(gray, xy, size, angle)


def dense_sift(
    gray: np.ndarray,
    xy: np.ndarray,
    size: float = 3.0,
    step_px: int = 1,
    gradient: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Compute OpenCV's SIFT descriptors, (N, 128) uint8, of upright keypoints all at once.

    OpenCV sums the gradients around each keypoint separately. If all keypoints are upright and of
    one size, a separable filter of the image gives these sums. Positions must be whole pixels
    inside the image, and lie only on every `step_px`-th row and column. A step above 1 takes less
    time. The size must lie within `DENSE_SIZES_PX`. `gradient` is the result of `sift_gradient`.
    """
    from .kernels import TILE_COLUMNS, TILE_HEIGHT, describe_tiles

    if not len(xy):
        return np.empty((0, 128), np.uint8)
    pixels = np.asarray(xy).astype(np.int64)
    origin = pixels.min(axis=0)
    column, row = ((pixels - origin) // step_px).T
    rows_of = np.full((row.max() + 1, column.max() + 1), -1, np.int32)
    rows_of[row, column] = np.arange(len(pixels))
    out = np.empty((len(pixels), 128), np.uint8)
    tiles_down = -(-len(rows_of) // max(1, TILE_HEIGHT // step_px))
    tiles_across = -(-rows_of.shape[1] // TILE_COLUMNS)
    gradient = sift_gradient(gray) if gradient is None else gradient
    arguments = (*gradient, rows_of, origin, step_px, *_taps(size))
    parallel_for(tiles_down * tiles_across, describe_tiles, *arguments, out)
    described = rows_of[row, column]
    return out if (described == np.arange(len(out))).all() else out[described]


def sift_gradient(gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the gradient of a (H, W) uint8 image for `dense_sift`.

    Returns (H, W) float32 magnitudes, 0 on the border, and orientations in units of 45 degrees.
    """
    blur = float(np.sqrt(BASE_SIGMA_PX**2 - CAMERA_SIGMA_PX**2))
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), blur)
    across, up = np.zeros_like(smooth), np.zeros_like(smooth)
    across[:, 1:-1] = smooth[:, 2:] - smooth[:, :-2]
    up[1:-1] = smooth[:-2] - smooth[2:]
    magnitude, degrees = cv2.cartToPolar(across, up, angleInDegrees=True)
    return magnitude, degrees * np.float32(8 / 360)


def _taps(size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels' weights in the four bins along an axis, as `describe_tiles` needs them."""
    from .kernels import TAPS_AT_ONCE

    width = BIN_WIDTH * size
    reach = int(np.ceil(2.5 * width)) - 1  # two bins on each side, and half a bin of overlap
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


def opencv_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute OpenCV's SIFT descriptors; arguments and result as in `sift_descriptors`."""
    if not len(xy):
        return np.empty((0, 128), np.uint8)
    keypoints = cv2.KeyPoint_convert(np.asarray(xy, np.float32), size=size)
    if angle != -1:
        for keypoint in keypoints:
            keypoint.angle = angle
    return _compute(cv2.SIFT_create(), gray, keypoints)


def scaled_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, sizes: np.ndarray, angles: np.ndarray
) -> np.ndarray:
    """Compute (N, 128) uint8 SIFT descriptors of keypoints at their own sizes and angles.

    As for SIFT's own keypoints, gradients come from the image of the scale space whose sigma is
    nearest to half the size. A descriptor covers a square whose side is six times the size.
    """
    if not len(xy):
        return np.empty((0, 128), np.uint8)
    octaves = packed_octaves(sizes, gray.shape)
    size, scores = (gray.shape[1], gray.shape[0]), np.zeros(len(xy))
    keypoints = Keypoints(xy, scores, size, sizes=sizes, angles=angles, octaves=octaves)
    # Without precise upscaling, octave -1 is shifted by a quarter of a pixel.
    sift = cv2.SIFT_create(nOctaveLayers=LAYERS, enable_precise_upscale=True)
    return _compute(sift, gray, keypoints.to_opencv())


def _compute(sift: cv2.SIFT, gray: np.ndarray, keypoints: list[cv2.KeyPoint]) -> np.ndarray:
    described, descriptors = sift.compute(gray, keypoints)
    if len(described) != len(keypoints):  # OpenCV would silently change the order of rows
        raise AssertionError("cv2.SIFT left out keypoints that were given to it")
    return descriptors.astype(np.uint8)  # OpenCV's floats are whole numbers from 0 to 255


def describe_keypoints(gray: np.ndarray, keypoints: Keypoints) -> Keypoints:
    """Return keypoints with RootSIFT descriptors.

    Keypoints with sizes are described at their own sizes and angles; unset angles are replaced by
    the dominant gradient orientations. Keypoints without sizes are described upright and with a
    diameter of 3 pixels, as in the DeepDetect paper.

    Args:
        gray: (H, W) uint8 luma of the image of the keypoints.
        keypoints: keypoints of any detector; angles of -1 are unset.

    Raises:
        ImageError: the image is not uint8, or has another size than `keypoints.image_size`.
        OptionError: a size is not above 0.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)
        >>> points = Keypoints([[30, 30]], [1], (64, 64), sizes=[5], angles=[90])
        >>> describe_keypoints(gray, points).descriptors.shape
        (1, 128)
    """
    if gray.dtype != np.uint8 or gray.shape[::-1] != keypoints.image_size:
        width, height = keypoints.image_size
        raise ImageError(
            f"keypoints of an image of {width}x{height} pixels need its uint8 luma, of shape "
            f"{(height, width)}, not {gray.dtype} of shape {gray.shape}"
        )
    xy, sizes, angles = keypoints.xy, keypoints.sizes, keypoints.angles
    if sizes is None:
        descriptors = sift_descriptors(gray, xy)
    else:
        if not (sizes > 0).all():
            raise OptionError("keypoints need sizes above 0 to be described")
        angles = set_angles(gray, xy, sizes, angles)
        descriptors = scaled_sift_descriptors(gray, xy, sizes, angles)
    root = to_root_sift(descriptors)
    return replace(keypoints, angles=angles, descriptors=root, descriptor_type=ROOT_SIFT)


def root_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute RootSIFT descriptors (`to_root_sift`); arguments as in `sift_descriptors`."""
    return to_root_sift(sift_descriptors(gray, xy, size, angle))


def to_root_sift(descriptors: np.ndarray) -> np.ndarray:
    """Convert (N, 128) uint8 SIFT descriptors to RootSIFT, in place.

    RootSIFT (Arandjelovic and Zisserman, 2012) is the square root of L1-normalised descriptors,
    here times 512 and at most 255. Its Euclidean distances are Hellinger distances of SIFT.
    """
    parallel_for(len(descriptors), _square_root, descriptors)
    return descriptors


def _square_root(start: int, stop: int, descriptors: np.ndarray) -> None:
    roots = np.sqrt(np.arange(256, dtype=np.float32))
    for first in range(start, stop, ROWS_AT_ONCE):
        rows = descriptors[first : min(first + ROWS_AT_ONCE, stop)]
        totals = np.maximum(rows.sum(1, dtype=np.int64), 1).astype(np.float32)
        values = roots.take(rows)
        values *= (np.float32(512) / np.sqrt(totals))[:, None]
        np.rint(values, out=values)
        rows[:] = np.minimum(values, 255, out=values)


Descriptor = Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]

DESCRIPTORS: dict[str, Descriptor] = {"sift": sift_descriptors, "rootsift": root_sift_descriptors}
