"""SIFT descriptors of any keypoints (paper, Section III-C), and well-spread keypoints of SIFT.

To add a descriptor, write a function `(gray, xy, size, angle) -> (N, D) uint8 or float32` and add
it to `DESCRIPTORS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.parallel import parallel_for
from .._shared.registry import look_up
from .dense_sift import MAX_SIZE_PX, MIN_SIZE_PX, dense_sift
from .keypoints import UNSET_ANGLE, Keypoints, on_pixels
from .orientation import dominant_angles
from .scale_space import LAYERS, nearest_layers

ROOT_SIFT = "rootsift"
"""`Keypoints.descriptor_type` of RootSIFT."""

CONTRAST_THRESHOLDS = (0.04, 0.01, 0.0025)
"""Of SIFT (Lowe: 0.04), in the order in which they are tried; the contrast of a keypoint is
compared after multiplication by the number of layers."""

MIN_KEYPOINTS = 1000
"""With fewer the next lower contrast threshold is tried."""

GRID_CELLS = 24
"""Along the longer side of the image; each cell gives its strongest keypoints in turn, so that all
parts of the image have some."""

MIN_DENSE_DENSITY = 0.02
"""Keypoints per pixel from which all at once (`dense_sift`) is faster than one by one."""


def sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute SIFT descriptors, by the fastest implementation for these keypoints.

    Many upright keypoints on whole pixels are described all at once, which differs from OpenCV's
    result by 1 in one of ten thousand numbers; others, and all of them without numba, by OpenCV.

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        size: diameter of the keypoint in pixels.
        angle: its orientation in degrees; 0 is upright. -1 is OpenCV's "unset", which its SIFT
            takes for a rotation by one degree; the published code does the same.

    Returns:
        (N, 128) uint8.

    Example:
        >>> sift_descriptors(np.zeros((32, 32), np.uint8), np.array([[8, 8]])).shape
        (1, 128)
    """
    dense = len(xy) > MIN_DENSE_DENSITY * gray.size
    upright = angle == 0 and MIN_SIZE_PX <= size <= MAX_SIZE_PX
    if dense and upright and on_pixels(xy, gray.shape):
        return dense_sift(gray, xy, size)
    return opencv_sift_descriptors(gray, xy, size, angle)


def opencv_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute OpenCV's SIFT descriptors; arguments and result as of `sift_descriptors`."""
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
    """Compute SIFT descriptors of keypoints at their own sizes and angles.

    The gradients are those of the image of the scale space that is nearest to the size, as of
    keypoints that SIFT detects itself. (`sift_descriptors` takes the finest image for all.)

    Args:
        gray: (H, W) uint8 luma.
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        sizes: (N,) diameters in pixels: twice sigma, as of OpenCV's keypoints of SIFT. A descriptor
            covers a square with six times this side.
        angles: (N,) orientations in degrees, as of `dominant_angles`.

    Returns:
        (N, 128) uint8.

    Example:
        >>> gray = np.zeros((64, 64), np.uint8)
        >>> scaled_sift_descriptors(gray, np.array([[30, 30]]), [5], [90]).shape
        (1, 128)
    """
    if not len(xy):
        return np.empty((0, 128), np.uint8)
    octaves, layers = nearest_layers(sizes, gray.shape)
    packed = (octaves & 255) | (layers << 8)  # as SIFT itself notes where a keypoint is from
    columns = (*np.asarray(xy, np.float32).T.tolist(), list(sizes), list(angles), packed.tolist())
    keypoints = [
        cv2.KeyPoint(x, y, float(size), float(angle), 0.0, octave)
        for x, y, size, angle, octave in zip(*columns, strict=True)
    ]
    # Without precise upscaling octave -1 is a quarter of a pixel off.
    sift = cv2.SIFT_create(nOctaveLayers=LAYERS, enable_precise_upscale=True)
    return _compute(sift, gray, keypoints)


def describe_keypoints(gray: np.ndarray, keypoints: Keypoints) -> Keypoints:
    """Return keypoints with RootSIFT descriptors.

    Keypoints with sizes are described at these and at their angles, where they have none at the
    dominant one; others all alike, with size 3 and upright, as in the paper.

    Args:
        gray: (H, W) uint8 luma of the image that they are keypoints of.
        keypoints: of any detector; angles of -1 are unset.

    Raises:
        OptionError: a size is not above 0.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.uint8)
        >>> points = Keypoints([[30, 30]], [1], (64, 64), sizes=[5], angles=[90])
        >>> describe_keypoints(gray, points).descriptors.shape
        (1, 128)
    """
    if keypoints.sizes is None:
        found = sift_descriptors(gray, keypoints.xy)
        return replace(
            keypoints, descriptors=to_root_sift(found, overwrite=True), descriptor_type=ROOT_SIFT
        )
    if not (keypoints.sizes > 0).all():
        raise OptionError("keypoints need sizes above 0 to be described: give them some")
    angles = np.full(len(keypoints), UNSET_ANGLE, np.float32)
    if keypoints.angles is not None:
        angles = keypoints.angles.copy()
    unset = np.flatnonzero(angles < 0)
    angles[unset] = dominant_angles(gray, keypoints.xy[unset], keypoints.sizes[unset])
    found = scaled_sift_descriptors(gray, keypoints.xy, keypoints.sizes, angles)
    return replace(
        keypoints,
        angles=angles,
        descriptors=to_root_sift(found, overwrite=True),
        descriptor_type=ROOT_SIFT,
    )


def _compute(sift: cv2.SIFT, gray: np.ndarray, keypoints: list[cv2.KeyPoint]) -> np.ndarray:
    described, descriptors = sift.compute(gray, keypoints)
    if len(described) != len(keypoints):  # it would silently break the order of rows
        raise AssertionError("cv2.SIFT left out keypoints that were given to it")
    return descriptors.astype(np.uint8)  # they are whole numbers from 0 to 255


def root_sift_descriptors(
    gray: np.ndarray, xy: np.ndarray, size: float = 3.0, angle: float = 0.0
) -> np.ndarray:
    """Compute RootSIFT descriptors (`to_root_sift`); arguments as of `sift_descriptors`."""
    return to_root_sift(sift_descriptors(gray, xy, size, angle), overwrite=True)


def to_root_sift(descriptors: np.ndarray, overwrite: bool = False) -> np.ndarray:
    """Convert SIFT descriptors to RootSIFT (Arandjelovic and Zisserman, 2012).

    Its Euclidean distance is the Hellinger distance of SIFT.

    Args:
        descriptors: (N, 128) uint8.
        overwrite: convert in place, which saves a copy.

    Returns:
        (N, 128) uint8: the square roots of the L1-normalised ones times 512, at most 255.
    """
    result = descriptors if overwrite else descriptors.copy()
    parallel_for(len(result), _square_root, result)
    return result


def _square_root(start: int, stop: int, descriptors: np.ndarray) -> None:
    """Convert the rows from `start` to before `stop` in place."""
    roots = np.sqrt(np.arange(256, dtype=np.float32))
    for first in range(start, stop, ROWS_AT_ONCE):
        rows = descriptors[first : min(first + ROWS_AT_ONCE, stop)]
        totals = np.maximum(rows.sum(1, dtype=np.int64), 1).astype(np.float32)
        values = roots.take(rows)
        values *= (np.float32(512) / np.sqrt(totals))[:, None]
        np.rint(values, out=values)
        rows[:] = np.minimum(values, 255, out=values)


def correlation_distance(
    first: np.ndarray,
    rows0: np.ndarray,
    second: np.ndarray,
    rows1: np.ndarray,
    mean: np.ndarray,
) -> np.ndarray:
    """Return the correlation distance of pairs of descriptors about a mean descriptor.

    Args:
        first, second: (N, D), (M, D) uint8 descriptors.
        rows0, rows1: (K,) rows of the pairs.
        mean: (D,) float32, subtracted from both.

    Returns:
        (K,) float32: 1 - correlation, from 0 to 2: 0 where both are equal, 0 but for rounding
        where they differ by a factor; 1 where one of them is the mean.

    Example:
        >>> a = np.array([[10, 20, 30], [30, 20, 10]], np.uint8)
        >>> mean = np.full(3, 20, np.float32)
        >>> correlation_distance(a, np.array([0, 0]), a, np.array([0, 1]), mean).round(3)
        array([0., 2.], dtype=float32)
    """
    from .kernels import correlation_distances

    rows0, rows1 = (np.ascontiguousarray(rows, np.int64) for rows in (rows0, rows1))
    mean = np.ascontiguousarray(mean, np.float32)
    out = np.empty(len(rows0), np.float32)
    parallel_for(len(out), correlation_distances, first, rows0, second, rows1, mean, out)
    return out


ROWS_AT_ONCE = 1024
"""Descriptors that are converted together, so that they stay in the processor's cache."""

Descriptor = Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]

DESCRIPTORS: dict[str, Descriptor] = {
    "sift": sift_descriptors,
    "rootsift": root_sift_descriptors,
    "sift-opencv": opencv_sift_descriptors,
}


def get_descriptor(name: str) -> Descriptor:
    """Return the descriptor of this name.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("descriptor", name, DESCRIPTORS)


def detect_sift(gray: np.ndarray, max_keypoints: int = 4000) -> Keypoints:
    """Detect SIFT keypoints, spread over the image, and describe them by RootSIFT.

    Args:
        gray: (H, W) uint8 luma.
        max_keypoints: at most this many.

    Returns:
        Keypoints with sizes, angles, octaves and (N, 128) uint8 descriptors, which are rotated to
        the keypoints' angles.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> detect_sift(gray, 20)
        Keypoints(20 keypoints in 99x99 pixels, scores 0.0135 to 0.0788, 128-D uint8 descriptors)
    """
    size = (gray.shape[1], gray.shape[0])
    # Found once: nearly all of the time goes into the pyramid, whatever the threshold.
    # Without precise upscaling OpenCV's positions are a quarter of a pixel off, right and down.
    sift = cv2.SIFT_create(
        nOctaveLayers=LAYERS,
        contrastThreshold=min(CONTRAST_THRESHOLDS),
        enable_precise_upscale=True,
    )
    every = sift.detect(gray, None)
    contrasts = LAYERS * np.array([keypoint.response for keypoint in every])
    enough = min(MIN_KEYPOINTS, max_keypoints)
    keypoints = every
    for threshold in CONTRAST_THRESHOLDS:
        if np.count_nonzero(contrasts >= threshold) >= enough:
            keypoints = [every[k] for k in np.flatnonzero(contrasts >= threshold)]
            break
    if not len(keypoints) or max_keypoints < 1:
        none = np.empty((0, 128), np.uint8)
        return replace(Keypoints.empty(size), descriptors=none, descriptor_type=ROOT_SIFT)
    strength = np.array([keypoint.response for keypoint in keypoints])
    xy = cv2.KeyPoint_convert(keypoints)
    chosen = spread_over_grid(xy, strength, size, max_keypoints)
    kept, descriptors = sift.compute(gray, [keypoints[k] for k in chosen])
    found = Keypoints.from_opencv(kept, size)
    root = to_root_sift(descriptors.astype(np.uint8))
    return replace(found, descriptors=root, descriptor_type=ROOT_SIFT)


def spread_over_grid(
    xy: np.ndarray,
    scores: np.ndarray,
    image_size: tuple[int, int],
    max_keypoints: int,
    grid_cells: int = GRID_CELLS,
) -> np.ndarray:
    """Choose keypoints by score, in turn from all cells of a grid.

    Args:
        xy: (N, 2) positions.
        scores: (N,), the higher the better.
        image_size: (width, height) of the image.
        max_keypoints: how many to choose.
        grid_cells: along the longer side.

    Returns:
        (M,) rows, M <= `max_keypoints`: first the best of each cell, then the second-best, ...

    Example:
        >>> xy = np.array([[1, 1], [2, 1], [99, 99]])
        >>> spread_over_grid(xy, np.array([3.0, 2.0, 1.0]), (100, 100), 2).tolist()
        [0, 2]
    """
    side = max(image_size) / grid_cells
    cell = np.floor(np.maximum(xy, 0) / side).astype(np.int64)
    cell = cell[:, 1] * (grid_cells + 1) + cell[:, 0]
    order = np.lexsort((-scores, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    begins = np.repeat(first, np.diff(first, append=len(order)))
    rank = np.arange(len(order)) - begins
    return order[np.lexsort((-scores[order], rank))][:max_keypoints]
