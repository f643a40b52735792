"""A second image rotated, scaled and sheared into the frame of the first, as far as depth allows.

Upright descriptors of one size compare only what is aligned. An affinity that fits most of the
sparse matches takes out roll, scale and the strongest part of a change of viewpoint; what remains
is the parallax along the epipolar lines. Rectified pairs are aligned already: they are left as
they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ...features.matchers import DescriptorMatches
from ...geometry.rescaling import ANTIALIASING_SIGMA
from .homography import ImagePair, nearest_keypoint
from .options import PrewarpOptions

BLOCK = 2_000_000
"""Pixels of the frame that are searched at a time, to bound the memory."""


@dataclass(frozen=True, eq=False)
class PrewarpedPair:
    """Two aligned images.

    Attributes:
        pair: the first image in its own frame, as blurred as the second is, with its keypoints;
            the warped second image, and its whole pixels that stand for keypoints.
        rows1: (M,) rows of the keypoints that these pixels stand for.
        to_second: (3, 3) affinity from the warped image to the second one.
    """

    pair: ImagePair
    rows1: np.ndarray
    to_second: np.ndarray

    def fundamental(self, matrix: np.ndarray) -> np.ndarray:
        """Return a fundamental matrix of the images as one to the warped image.

        x1 = A x and x1^T F x0 = 0 give x^T (A^T F) x0 = 0.
        """
        return self.to_second.T @ matrix

    def original(self, found: DescriptorMatches) -> DescriptorMatches:
        """Return matches of this pair as matches of the keypoints of the original one."""
        return DescriptorMatches(found.rows0, self.rows1[found.rows1], found.ratios)


def estimate_affinity(
    points0: np.ndarray, points1: np.ndarray, options: PrewarpOptions = PrewarpOptions()
) -> np.ndarray | None:
    """Estimate the affinity that fits most matches of a scene with depth (least median).

    Args:
        points0, points1: (N, 2) matched positions that fit the epipolar geometry.
        options: which affinities matter, and which are trusted.

    Returns:
        (3, 3) from the first image to the second; None when none can be trusted, and when both
        images are aligned without it.

    Example:
        >>> points = np.random.default_rng(0).random((20, 2)) * 100
        >>> quarter = estimate_affinity(points, points[:, ::-1] * (1, -1))
        >>> np.allclose(quarter, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        True
        >>> estimate_affinity(points, points + (7, 0)) is None
        True
    """
    if len(points0) < 3:
        return None
    found, _ = cv2.estimateAffine2D(
        np.ascontiguousarray(points0, np.float64),
        np.ascontiguousarray(points1, np.float64),
        method=cv2.LMEDS,
    )
    if found is None or not np.isfinite(found).all():
        return None
    linear = found[:, :2]
    largest, smallest = np.linalg.svd(linear, compute_uv=False)
    limit = options.max_anisotropy
    trusted = (
        np.linalg.det(linear) > 0
        and largest < limit * smallest
        and largest < limit
        and smallest > 1 / limit
    )
    if not trusted or np.linalg.norm(linear - np.eye(2), 2) < options.min_deviation:
        return None
    return np.vstack([found, [0, 0, 1]])


def prewarp(
    pair: ImagePair, affinity: np.ndarray, options: PrewarpOptions = PrewarpOptions()
) -> PrewarpedPair:
    """Warp the second image to the first; several pixels may stand for a keypoint."""
    gray0, gray1 = pair.gray0, pair.gray1
    left, top, width, height = _frame(gray0.shape, gray1.shape, affinity, options.frame_margin)
    to_second = affinity @ np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]])
    # The finer image is blurred as the coarser one is by its lack of pixels.
    scale = float(np.sqrt(np.linalg.det(affinity[:2, :2])))
    warped = cv2.warpAffine(
        _blur_to_scale(gray1, scale),
        to_second[:2],
        (width, height),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels, rows1 = _pixels_of_keypoints(
        pair.xy1, to_second, (width, height), gray1.shape, options.max_distance_px
    )
    aligned = ImagePair(_blur_to_scale(gray0, 1 / scale), warped, pair.xy0, pixels)
    return PrewarpedPair(aligned, rows1, to_second)


def _pixels_of_keypoints(
    xy1: np.ndarray,
    to_second: np.ndarray,
    size: tuple[int, int],
    shape1: tuple[int, ...],
    max_distance_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels of the frame that have a keypoint near, and its row, some lines at a time."""
    width, height = size
    lines = max(1, BLOCK // width)
    pixels, rows = [], []
    for top in range(0, height, lines):
        row, column = np.indices((min(lines, height - top), width))
        part = np.column_stack([column.ravel(), row.ravel() + top])
        places = part @ to_second[:2, :2].T + to_second[:2, 2]
        found, distances = nearest_keypoint(places, xy1, (shape1[1], shape1[0]))
        near = distances < max_distance_px
        pixels.append(part[near].astype(np.float32))
        rows.append(found[near].astype(np.int64))
    return np.concatenate(pixels), np.concatenate(rows)


def _frame(
    shape0: tuple[int, ...], shape1: tuple[int, ...], affinity: np.ndarray, margin: float
) -> tuple[int, int, int, int]:
    """Return left, top, width and height of what is shown of the second image."""
    right, bottom = shape1[1] - 1, shape1[0] - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]]).T
    there = (np.linalg.inv(affinity) @ corners)[:2]
    sides = np.array([shape0[1], shape0[0]])
    first = np.maximum(np.floor(there.min(1)), np.floor(-margin * sides))
    last = np.minimum(np.ceil(there.max(1)), np.ceil((1 + margin) * sides))
    size = np.maximum(last - first + 1, 1)
    return int(first[0]), int(first[1]), int(size[0]), int(size[1])


def _blur_to_scale(gray: np.ndarray, scale: float) -> np.ndarray:
    """Blur an image as one is that is this many times smaller."""
    if scale <= 1:
        return gray
    return cv2.GaussianBlur(gray, (0, 0), ANTIALIASING_SIGMA * float(np.sqrt(scale**2 - 1)))
