"""Few, well-spread SIFT keypoints with directions and sizes, for the first look at a pair."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .dense_sift import root

MOST = 4000
"""Keypoints of an image."""

ENOUGH = 1000
CONTRASTS = (0.04, 0.01, 0.0025)
"""SIFT's threshold of contrast (Lowe: 0.04); the next is tried where there are not enough."""

CELLS = 24
"""Cells along the longer side; each gives its strongest keypoints, so that all parts have some."""


@dataclass(frozen=True, eq=False)
class SparseFeatures:
    """Described keypoints.

    Attributes:
        xy: (N, 2) float32 positions, centre of the first pixel (0, 0).
        descriptors: (N, 128) uint8 RootSIFT, turned into the keypoints' directions.
    """

    xy: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.xy)


def sparse_features(gray: np.ndarray, most: int = MOST) -> SparseFeatures:
    """Find SIFT keypoints, spread over the image.

    Args:
        gray: (H, W) uint8 luma.
        most: of them.

    Example:
        >>> gray = np.random.default_rng(0).integers(0, 256, (99, 99)).astype(np.uint8)
        >>> len(sparse_features(gray, 20))
        20
    """
    for contrast in CONTRASTS:
        # Without this OpenCV's positions are a quarter of a pixel off, right and down.
        sift = cv2.SIFT_create(contrastThreshold=contrast, enable_precise_upscale=True)
        keypoints = sift.detect(gray, None)
        if len(keypoints) >= min(ENOUGH, most):
            break
    xy = cv2.KeyPoint_convert(keypoints)
    if not len(xy) or most < 1:
        return SparseFeatures(np.empty((0, 2), np.float32), np.empty((0, 128), np.uint8))
    strength = np.array([keypoint.response for keypoint in keypoints])
    chosen = spread(xy, strength, (gray.shape[1], gray.shape[0]), most)
    kept, descriptors = sift.compute(gray, [keypoints[k] for k in chosen])
    return SparseFeatures(cv2.KeyPoint_convert(kept), root(descriptors.astype(np.uint8)))


def spread(xy: np.ndarray, strength: np.ndarray, size: tuple[int, int], most: int) -> np.ndarray:
    """Choose keypoints by strength, in turn from all cells of a grid.

    Args:
        xy: (N, 2) positions.
        strength: (N,) of each.
        size: (width, height) of the image.
        most: how many to choose.

    Returns:
        (M,) rows, M <= `most`: first the strongest of each cell, then the second-strongest, ...

    Example:
        >>> xy = np.array([[1, 1], [2, 1], [99, 99]])
        >>> spread(xy, np.array([3.0, 2.0, 1.0]), (100, 100), 2).tolist()
        [0, 2]
    """
    side = max(size) / CELLS
    cell = np.floor(np.maximum(xy, 0) / side).astype(np.int64)
    cell = cell[:, 1] * (CELLS + 1) + cell[:, 0]
    order = np.lexsort((-strength, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    begins = np.repeat(first, np.diff(first, append=len(order)))
    rank = np.arange(len(order)) - begins
    return order[np.lexsort((-strength[order], rank))][:most]
