"""Choose image pairs of a collection for matching, in a reproducible way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


FRAME_DISTANCES = (1, 3, 5, 10, 15, 20)
"""Images of a sequence are paired at these distances in frames. Chosen by hand; not measured."""


def unordered_pairs(count: int, max_pairs: int) -> list[tuple[int, int]]:
    """Choose all pairs of `count` unordered images, or at most `max_pairs` evenly spaced ones."""
    # The full list of pairs is not made, because ten thousand images have fifty million pairs.
    ends = np.cumsum(np.arange(count - 1, 0, -1))
    ranks = np.array(evenly_spaced(range(count * (count - 1) // 2), max_pairs), int)
    first = np.searchsorted(ends, ranks, side="right")
    second = ranks - ends[first] + count
    return list(zip(first.tolist(), second.tolist(), strict=True))


def sequence_pairs(
    frames: Sequence[int], max_pairs: int, distances: Sequence[int]
) -> list[tuple[int, int]]:
    """Choose evenly spaced pairs of frame numbers, equally many at each of the `distances`."""
    existing = set(frames)
    starts_per_distance = max(1, max_pairs // len(distances))
    pairs = [
        (start, start + distance)
        for distance in distances
        for start in evenly_spaced(
            [frame for frame in frames if frame + distance in existing], starts_per_distance
        )
    ]
    return evenly_spaced(pairs, max_pairs)


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` evenly spaced items of a sequence, with the first and the last."""
    if len(items) <= count:
        return list(items)
    return [items[row] for row in np.linspace(0, len(items) - 1, count).round().astype(int)]
