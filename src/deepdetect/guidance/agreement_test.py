"""Which points look alike in both images once the geometry is taken out.

The second image is warped into the frame of the first; descriptors are taken from both at the same
pixels. What two places that have nothing to do with each other look like is measured on the pair
itself, by comparing with the warped image moved by a third of its size: a point agrees when its
descriptors, with those around it, are nearer than all but a fiftieth of such strangers.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..descriptors.dense_sift import dense_sift, root

SIZE = 6.0
"""Diameter of the keypoints for these descriptors, in pixels."""

STRANGERS = 0.02
"""Share of strangers that would pass."""

TOGETHER = 2.5
"""Sigma in pixels of the mean over the points around: neighbours agree together."""

MOVES = ((1 / 2, 0), (0, 1 / 2), (1 / 3, 1 / 3))
"""Shares of width and height that the strangers are apart."""

BLOCK = 64
BLOCKS = 24
"""Side in pixels and number of the blocks of the image that strangers are taken from."""


def alike(
    gray0: np.ndarray, warped: np.ndarray, seen: np.ndarray, pixels: np.ndarray, seed: int = 0
) -> np.ndarray:
    """Tell which points agree, (N,) bool; arguments as of `unlikeness`."""
    return unlikeness(gray0, warped, seen, pixels, seed) < 1


def unlikeness(
    gray0: np.ndarray, warped: np.ndarray, seen: np.ndarray, pixels: np.ndarray, seed: int = 0
) -> np.ndarray:
    """Compare the surroundings of points.

    Args:
        gray0: (H, W) uint8, the first image.
        warped: (H, W) uint8, the second one in the frame of the first.
        seen: (H, W) bool, where that has content.
        pixels: (N, 2) whole pixels of the first image.
        seed: of the choice of strangers.

    Returns:
        (N,) float32: the distance of the descriptors, with those around, over that which a share
        of `STRANGERS` stays under; infinite where the second image is not seen.
    """
    pixels = np.asarray(pixels).astype(np.int64)
    result = np.full(len(pixels), np.inf, np.float32)
    known = np.flatnonzero(seen[pixels[:, 1], pixels[:, 0]])
    if not len(known):
        return result
    described = _described(gray0, pixels[known])
    distances = _distances(described, _described(warped, pixels[known]))
    nearness = _together(pixels[known], distances, gray0.shape)
    strangers = _strangers(gray0.shape, warped, seen, pixels[known], described, seed)
    if not len(strangers):
        return result
    result[known] = nearness / max(np.quantile(strangers, STRANGERS), 1e-6)
    return result


def _strangers(
    shape: tuple[int, ...],
    warped: np.ndarray,
    seen: np.ndarray,
    pixels: np.ndarray,
    described: np.ndarray,
    seed: int,
) -> np.ndarray:
    """Return the distances of points from places elsewhere, meant as their own are."""
    in_blocks = _some_blocks(pixels, seed)
    here, descriptors = pixels[in_blocks], described[in_blocks]
    found = []
    for across, down in MOVES:
        move = round(down * shape[0]), round(across * shape[1])
        moved, also = (np.roll(image, move, (0, 1)) for image in (warped, seen))
        valid = also[here[:, 1], here[:, 0]]
        if valid.any():
            places = here[valid]
            distances = _distances(descriptors[valid], _described(moved, places))
            found.append(_together(places, distances, shape))
    return np.concatenate(found) if found else np.empty(0)


def _some_blocks(pixels: np.ndarray, seed: int) -> np.ndarray:
    """Choose the points of some blocks of the image: whole blocks, as neighbours are meant."""
    block = pixels // BLOCK
    number = block[:, 1] * 1_000_000 + block[:, 0]
    numbers = np.unique(number)
    chosen = np.random.default_rng(seed).permutation(numbers)[:BLOCKS]
    return np.isin(number, chosen)


def _described(gray: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return root(dense_sift(gray, pixels, SIZE))


def _distances(first: np.ndarray, second: np.ndarray, step: int = 20_000) -> np.ndarray:
    """Return the Euclidean distance of each pair of rows, (N,) float32."""
    result = np.empty(len(first), np.float32)
    for start in range(0, len(first), step):
        gap = first[start : start + step].astype(np.float32) - second[start : start + step]
        result[start : start + step] = np.sqrt(np.einsum("ij,ij->i", gap, gap))
    return result


def _together(pixels: np.ndarray, values: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the weighted mean of the values of the points around each, (N,) float32."""
    count, total = np.zeros(shape[:2], np.float32), np.zeros(shape[:2], np.float32)
    count[pixels[:, 1], pixels[:, 0]] = 1
    total[pixels[:, 1], pixels[:, 0]] = values
    count, total = (cv2.GaussianBlur(image, (0, 0), TOGETHER) for image in (count, total))
    return (total / np.maximum(count, 1e-6))[pixels[:, 1], pixels[:, 0]]
