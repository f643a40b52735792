"""A few thousand well-spread SIFT keypoints with their own sizes and orientations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from .keypoints import Keypoints
from .sift import ROOT_SIFT, to_root_sift

OCTAVE_LAYERS = 3
"""Of SIFT (Lowe): the contrast of a keypoint is compared after multiplication by their number."""


@suggest_keywords
@dataclass(frozen=True)
class SiftOptions:
    """How many SIFT keypoints are detected, and where.

    Attributes:
        max_keypoints: per image.
        min_keypoints: with fewer than this, the next lower contrast threshold is tried.
        contrast_thresholds: of SIFT (Lowe: 0.04), in the order in which they are tried.
        grid_cells: along the longer side of the image; each cell gives its strongest keypoints
            in turn, so that all parts of the image have some.

    Raises:
        OptionError: a value is out of its range.
    """

    max_keypoints: int = 4000
    min_keypoints: int = 1000
    contrast_thresholds: tuple[float, ...] = (0.04, 0.01, 0.0025)
    grid_cells: int = 24

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("contrast_thresholds", "grid_cells"),
            not_negative=("max_keypoints", "min_keypoints"),
        )


def detect_sift(gray: np.ndarray, options: SiftOptions = SiftOptions()) -> Keypoints:
    """Detect SIFT keypoints, spread over the image, and describe them by RootSIFT.

    Args:
        gray: (H, W) uint8 luma.
        options: how many, and where.

    Returns:
        Keypoints with sizes, angles, octaves and (N, 128) uint8 descriptors, which are rotated to
        the keypoints' angles.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> detect_sift(gray, SiftOptions(max_keypoints=20))
        Keypoints(20 keypoints in 99x99 pixels, scores 0.0135 to 0.0788, 128-D uint8 descriptors)
    """
    size = (gray.shape[1], gray.shape[0])
    # Found once: nearly all of the time goes into the pyramid, whatever the threshold.
    # Without precise upscaling OpenCV's positions are a quarter of a pixel off, right and down.
    sift = cv2.SIFT_create(
        nOctaveLayers=OCTAVE_LAYERS,
        contrastThreshold=min(options.contrast_thresholds),
        enable_precise_upscale=True,
    )
    every = sift.detect(gray, None)
    contrasts = OCTAVE_LAYERS * np.array([keypoint.response for keypoint in every])
    enough = min(options.min_keypoints, options.max_keypoints)
    keypoints = every
    for threshold in options.contrast_thresholds:
        if np.count_nonzero(contrasts >= threshold) >= enough:
            keypoints = [every[k] for k in np.flatnonzero(contrasts >= threshold)]
            break
    if not len(keypoints) or options.max_keypoints < 1:
        none = np.empty((0, 128), np.uint8)
        return replace(Keypoints.empty(size), descriptors=none, descriptor_type=ROOT_SIFT)
    strength = np.array([keypoint.response for keypoint in keypoints])
    xy = cv2.KeyPoint_convert(keypoints)
    chosen = spread_over_grid(xy, strength, size, options.max_keypoints, options.grid_cells)
    kept, descriptors = sift.compute(gray, [keypoints[k] for k in chosen])
    found = Keypoints.from_opencv(kept, size)
    root = to_root_sift(descriptors.astype(np.uint8))
    return replace(found, descriptors=root, descriptor_type=ROOT_SIFT)


def spread_over_grid(
    xy: np.ndarray,
    scores: np.ndarray,
    image_size: tuple[int, int],
    max_keypoints: int,
    grid_cells: int = SiftOptions.grid_cells,
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
