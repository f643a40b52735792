"""Which places of the second image have nothing to do with points of the first.

The second image, warped into the frame of the first, is moved by a large share of its size: what
then lies under a point is a stranger to it, of the same kind of scene and light. Far from edges a
descriptor is the same with and without the move: there the image that is not moved is described,
once for all moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MOVES = ((1 / 2, 0), (0, 1 / 2), (1 / 3, 1 / 3))
"""Shares of width and height that the strangers are apart."""

EDGE = 36
"""Pixels that the larger descriptors reach, with the gradient and the blur that they are of."""

BLOCK = 64
BLOCKS = 256
"""Side in pixels of the blocks of the image that each move takes strangers from, and how many: all
of them up to a megapixel, so that chance has no say there."""


@dataclass(frozen=True)
class Strangers:
    """The strangers of some points by one move."""

    rows: np.ndarray
    """(N,) the points that have one."""
    places: np.ndarray
    """(N, 2) where in the second image theirs are."""
    whole: np.ndarray
    """(N,) bool: no descriptor reaches an edge: it is the same with and without the move."""
    moved: np.ndarray
    """(H, W) uint8, the second image moved: what leaves it on one side comes in on the other."""


def choose_strangers(
    points: np.ndarray, warped: np.ndarray, seen: np.ndarray, seed: int
) -> list[Strangers]:
    """Choose strangers, those of points in some blocks of the image.

    Args:
        points: (N, 2) int64 pixels of the first image.
        warped: (H, W) uint8, the second one in the frame of the first.
        seen: (H, W) bool, where that has content: strangers lie there only.
        seed: of the choice of blocks, which has a say beyond a megapixel only.

    Returns:
        The strangers, one entry a move.
    """
    size = np.array(warped.shape[::-1])
    result = []
    for rows, share in zip(_some_blocks(points, seed), MOVES, strict=True):
        move = np.rint(share * size).astype(np.int64)
        places = (points[rows] - move) % size
        known = seen[places[:, 1], places[:, 0]]
        rows, places = rows[known], places[known]
        inner = [
            (np.minimum(xy, size - 1 - xy) >= EDGE).all(axis=1) for xy in (points[rows], places)
        ]
        moved = np.roll(warped, move[::-1], (0, 1))
        result.append(Strangers(rows, places, inner[0] & inner[1], moved))
    return result


def numbered(pixels: np.ndarray, shape: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the different ones of some pixels, (P, 2), and the (H, W) image of their rows."""
    number = np.full(tuple(shape[:2]), -1, np.int32)
    number[pixels[:, 1], pixels[:, 0]] = 0
    row, column = np.nonzero(number == 0)
    number[row, column] = np.arange(len(row))
    return np.column_stack([column, row]), number


def _some_blocks(pixels: np.ndarray, seed: int) -> list[np.ndarray]:
    """Choose the points of some blocks for each move: whole blocks, as neighbours are meant."""
    block = pixels // BLOCK
    number = block[:, 1] * 1_000_000 + block[:, 0]
    order = np.random.default_rng(seed).permutation(np.unique(number))
    # Other blocks for every move where there are enough, the same again where there are not.
    turns = [np.roll(order, -move * BLOCKS)[:BLOCKS] for move in range(len(MOVES))]
    return [np.flatnonzero(np.isin(number, chosen)) for chosen in turns]
