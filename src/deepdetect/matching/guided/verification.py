"""Which points look alike in both images once the geometry is taken out.

The second image is warped into the frame of the first, and descriptors are taken from both at the
same pixels, small and large ones. They are compared by their correlation, with the mean descriptor
taken away: all descriptors have much in common, those of noise-like texture nearly everything.
What two places that have nothing to do with each other look like is measured on the pair itself,
by comparing with the warped image moved by a third of its size and more (`strangers`). A point
agrees when its descriptors, with those right around it, are more alike than all but a hundredth of
such strangers, and when most points about it agree too. Every second point is described, as on a
chessboard: its neighbours share what it says.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ...features.dense_sift import dense_sift
from ...features.sift import correlation_distance, to_root_sift
from .strangers import choose_strangers, numbered

SIZES = (3.0, 8.0)
"""Diameters of the keypoints for these descriptors, in pixels."""

STRANGERS = 0.01
"""Share of strangers that would pass by themselves."""

TOGETHER = 2.5
"""Sigma in pixels of the mean over the points right around: neighbours agree together."""

CROWD = 81
MAJORITY = 0.5
"""Side in pixels of the window about a point, and the share of its points that must agree."""

NEAR = 5
"""Side in pixels of the window in which one of the described points must lie."""

SAME = 1e-6
"""Rounding: so unlike are equal descriptors at most."""

FEW = 100
"""With fewer points no mean is taken away: theirs would be near to themselves."""


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
        (N,) float32: how unlike they are (1 - correlation, with those around) over the bound that
        a share of `STRANGERS` stays under. Infinite where the second image is not seen, where
        most points about do not agree, and everywhere when strangers all look the same.
    """
    pixels = np.asarray(pixels).astype(np.int64)
    result = np.full(len(pixels), np.inf, np.float32)
    known = np.flatnonzero(seen[pixels[:, 1], pixels[:, 0]])
    if not len(known):
        return result
    here = pixels[known]
    described = here[_thinned(here, gray0.shape)]
    moves = choose_strangers(described, warped, seen, seed)
    # Each place of the second image is described once, however often it is a stranger.
    used = [described, *(move.places[move.whole] for move in moves)]
    places, number = numbered(np.concatenate(used), seen.shape)
    own = number[described[:, 1], described[:, 0]]
    unlike = np.zeros(len(described), np.float32)
    stranger = [np.zeros(len(move.rows), np.float32) for move in moves]
    for size in SIZES:
        first = to_root_sift(dense_sift(gray0, described, size), overwrite=True)
        total = first.sum(axis=0, dtype=np.int64)  # whole: the order of the points has no say
        mean = (total / len(first) if len(first) >= FEW else 0 * total).astype(np.float32)
        second = to_root_sift(dense_sift(warped, places, size), overwrite=True)
        unlike += correlation_distance(first, np.arange(len(first)), second, own, mean)
        for values, move in zip(stranger, moves, strict=True):
            x, y = move.places[move.whole].T
            rows, cut = move.rows[move.whole], move.rows[~move.whole]
            values[move.whole] += correlation_distance(first, rows, second, number[y, x], mean)
            others = to_root_sift(dense_sift(move.moved, described[cut], size), overwrite=True)
            values[~move.whole] += correlation_distance(
                first, cut, others, np.arange(len(cut)), mean
            )
    means = [
        _together(described[move.rows], values, described[move.rows], gray0.shape)
        for move, values in zip(moves, stranger, strict=True)
    ]
    strangers = np.concatenate(means)
    bound = np.quantile(strangers, STRANGERS) if len(strangers) else 0
    if bound <= SAME:  # strangers are all the same: likeness tells nothing
        return result
    ratios = _together(described, unlike, here, gray0.shape) / np.float32(bound)
    crowd = _share_about(here, ratios < 1, gray0.shape)
    result[known] = np.where(crowd >= MAJORITY, ratios, np.inf)
    return result


def _thinned(pixels: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the rows of every second point, and of those with none of these near."""
    second = pixels.sum(axis=1) % 2 == 0
    image = _image(pixels, second, shape)
    near = cv2.dilate(image, np.ones((NEAR, NEAR), np.uint8))[pixels[:, 1], pixels[:, 0]] > 0
    return np.flatnonzero(second | ~near)


def _together(
    pixels: np.ndarray, values: np.ndarray, places: np.ndarray, shape: Sequence[int]
) -> np.ndarray:
    """Return the weighted mean of the values of the points around each place, (N,) float32."""
    count, total = (_image(pixels, part, shape) for part in (np.float32(1), values))
    count, total = (cv2.GaussianBlur(image, (0, 0), TOGETHER) for image in (count, total))
    return (total / np.maximum(count, 1e-6))[places[:, 1], places[:, 0]]


def _share_about(pixels: np.ndarray, agree: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Return the share of the points in the window about each that agree, (N,) float32."""
    count, total = (_image(pixels, part, shape) for part in (np.float32(1), agree))
    sums = [
        cv2.boxFilter(image, -1, (CROWD, CROWD), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for image in (count, total)
    ]
    return (sums[1] / np.maximum(sums[0], 1))[pixels[:, 1], pixels[:, 0]]


def _image(pixels: np.ndarray, values: np.ndarray | np.float32, shape: Sequence[int]) -> np.ndarray:
    image = np.zeros(tuple(shape[:2]), np.float32)
    image[pixels[:, 1], pixels[:, 0]] = values
    return image
