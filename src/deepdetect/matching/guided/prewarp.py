"""A second image turned, scaled and sheared into the frame of the first, as far as depth allows.

Upright descriptors of one size compare only what stands alike. An affinity that fits most of the
sparse matches takes roll, scale and the strongest part of a change of viewpoint out; what remains
is the parallax along the epipolar lines. Rectified pairs stand alike already: they are left as
they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ...geometry.rescaling import ANTIALIASING_SIGMA
from .homography import nearest_pixel

TURN = 0.15
"""How far the affinity may move a point, as a share of its distance from another, before it
matters. The floor shears rectified pairs by less (0.13 on art), and so small a turn costs less
than the warp; 12 degrees of roll cost most of the matches."""

STRETCH = 6.0
"""An affinity that stretches one direction more, against the other or in all, is not believed."""

MARGIN = 0.25
"""Share of the first image's sides that the frame may reach beyond it: parallax takes points
there. It bounds the memory."""

REACH = 1.0
"""A pixel of the frame stands for a keypoint nearer than this, in pixels of the second image."""

STEP = 2_000_000
"""Pixels of the frame that are looked at at a time, to bound the memory."""


@dataclass(frozen=True, eq=False)
class Straightened:
    """Two images that stand alike.

    Attributes:
        gray0: (H0, W0) uint8 first image, in its own frame, as blurred as the second is.
        gray1: (H, W) uint8 second image, warped.
        xy1: (M, 2) float32 whole pixels of the warped image that stand for keypoints.
        rows1: (M,) rows of these keypoints.
        to_second: (3, 3) affinity from the warped image to the second one.
    """

    gray0: np.ndarray
    gray1: np.ndarray
    xy1: np.ndarray
    rows1: np.ndarray
    to_second: np.ndarray

    def fundamental(self, matrix: np.ndarray) -> np.ndarray:
        """Return a fundamental matrix of the images as one to the warped image.

        x1 = A x and x1^T F x0 = 0 give x^T (A^T F) x0 = 0.
        """
        return self.to_second.T @ matrix


def affinity_between(points0: np.ndarray, points1: np.ndarray) -> np.ndarray | None:
    """Estimate the affinity that fits most matches of a scene with depth (least median).

    Args:
        points0, points1: (N, 2) matched positions that fit the epipolar geometry.

    Returns:
        (3, 3) from the first image to the second; None when there is none that can be believed,
        and when both images stand alike without it.

    Example:
        >>> points = np.random.default_rng(0).random((20, 2)) * 100
        >>> quarter = affinity_between(points, points[:, ::-1] * (1, -1))
        >>> np.allclose(quarter, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
        True
        >>> affinity_between(points, points + (7, 0)) is None
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
    believed = (
        np.linalg.det(linear) > 0
        and largest < STRETCH * smallest
        and largest < STRETCH
        and smallest > 1 / STRETCH
    )
    if not believed or np.linalg.norm(linear - np.eye(2), 2) < TURN:
        return None
    return np.vstack([found, [0, 0, 1]])


def straightened(
    gray0: np.ndarray, gray1: np.ndarray, xy1: np.ndarray, affinity: np.ndarray
) -> Straightened:
    """Show the second image, and its keypoints, as the first one stands.

    Args:
        gray0, gray1: (H0, W0), (H1, W1) uint8 luma.
        xy1: (N, 2) keypoints of the second image, on whole pixels.
        affinity: (3, 3) from the first image to the second.

    Returns:
        Both images, and the pixels of the warped one that lie within `REACH` of a keypoint:
        a keypoint may have several.
    """
    left, top, width, height = _frame(gray0.shape, gray1.shape, affinity)
    to_second = affinity @ np.array([[1.0, 0, left], [0, 1, top], [0, 0, 1]])
    # The finer image is blurred as the coarser one is by its lack of pixels.
    scale = float(np.sqrt(np.linalg.det(affinity[:2, :2])))
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(
        _as_coarse(gray1, scale),
        to_second[:2],
        (width, height),
        flags=flags,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels, rows = _standing_for(xy1, to_second, (width, height), gray1.shape)
    return Straightened(_as_coarse(gray0, 1 / scale), warped, pixels, rows, to_second)


def _standing_for(
    xy1: np.ndarray, to_second: np.ndarray, size: tuple[int, int], shape1: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels of the frame that have a keypoint near, and its row, some lines at a time."""
    width, height = size
    lines = max(1, STEP // width)
    pixels, rows = [], []
    for top in range(0, height, lines):
        row, column = np.indices((min(lines, height - top), width))
        part = np.column_stack([column.ravel(), row.ravel() + top])
        places = part @ to_second[:2, :2].T + to_second[:2, 2]
        found, distances = nearest_pixel(places, xy1, (shape1[1], shape1[0]))
        near = distances < REACH
        pixels.append(part[near].astype(np.float32))
        rows.append(found[near].astype(np.int64))
    return np.concatenate(pixels), np.concatenate(rows)


def _frame(
    shape0: tuple[int, ...], shape1: tuple[int, ...], affinity: np.ndarray
) -> tuple[int, int, int, int]:
    """Return left, top, width and height of what is shown of the second image."""
    right, bottom = shape1[1] - 1, shape1[0] - 1
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1]]).T
    there = (np.linalg.inv(affinity) @ corners)[:2]
    sides = np.array([shape0[1], shape0[0]])
    first = np.maximum(np.floor(there.min(1)), np.floor(-MARGIN * sides))
    last = np.minimum(np.ceil(there.max(1)), np.ceil((1 + MARGIN) * sides))
    size = np.maximum(last - first + 1, 1)
    return int(first[0]), int(first[1]), int(size[0]), int(size[1])


def _as_coarse(gray: np.ndarray, scale: float) -> np.ndarray:
    """Blur an image as one that is so many times smaller."""
    if scale <= 1:
        return gray
    return cv2.GaussianBlur(gray, (0, 0), ANTIALIASING_SIGMA * float(np.sqrt(scale**2 - 1)))
