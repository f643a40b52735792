"""Which pairs of a collection of images are matched: the same ones every time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from .._shared.options import check_ranges, suggest_keywords

Item = TypeVar("Item")


@suggest_keywords
@dataclass(frozen=True)
class PairSelectionOptions:
    """Which pairs of a scene are chosen; the same ones every time.

    Attributes:
        max_pairs: at most this many pairs of a scene. Of images in no order all pairs, where there
            are more an evenly spaced choice; of a sequence as many at each frame distance.
        frame_distances: between the two images of a pair, in frames, of a sequence.

    Raises:
        OptionError: a value is out of its range.
    """

    max_pairs: int = 60
    frame_distances: tuple[int, ...] = (1, 3, 5, 10, 15, 20)

    def __post_init__(self) -> None:
        check_ranges(self, positive=("max_pairs", "frame_distances"))


def unordered_pairs(count: int, max_pairs: int) -> list[tuple[int, int]]:
    """Choose pairs of images in no order: all, or where there are more evenly spaced ones.

    Args:
        count: of the images.
        max_pairs: at most this many.

    Example:
        >>> unordered_pairs(3, 60)
        [(0, 1), (0, 2), (1, 2)]
        >>> unordered_pairs(100, 3)
        [(0, 1), (29, 39), (98, 99)]
    """
    # Counted, not listed: ten thousand images have fifty million pairs.
    ends = np.cumsum(np.arange(count - 1, 0, -1))
    ranks = np.array(evenly_spaced(range(count * (count - 1) // 2), max_pairs), int)
    first = np.searchsorted(ends, ranks, side="right")
    second = ranks - ends[first] + count
    return list(zip(first.tolist(), second.tolist(), strict=True))


def sequence_pairs(frames: Sequence[int], options: PairSelectionOptions) -> list[tuple[int, int]]:
    """Choose pairs of frames: as many evenly spaced ones at each of the distances.

    Args:
        frames: their numbers, ascending; some may be missing.
        options: the distances, and how many pairs.

    Returns:
        Pairs of numbers, at most `options.max_pairs`.

    Example:
        >>> sequence_pairs(range(12), PairSelectionOptions(max_pairs=5, frame_distances=(1, 10)))
        [(0, 1), (10, 11), (0, 10), (1, 11)]
    """
    there = set(frames)
    starts_per_distance = max(1, options.max_pairs // len(options.frame_distances))
    pairs = [
        (start, start + distance)
        for distance in options.frame_distances
        for start in evenly_spaced(
            [frame for frame in frames if frame + distance in there], starts_per_distance
        )
    ]
    return evenly_spaced(pairs, options.max_pairs)


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Return evenly spaced ones of a sequence, the first and the last included.

    Example:
        >>> evenly_spaced(range(10), 4)
        [0, 3, 6, 9]
    """
    if len(items) <= count:
        return list(items)
    return [items[row] for row in np.linspace(0, len(items) - 1, count).round().astype(int)]
