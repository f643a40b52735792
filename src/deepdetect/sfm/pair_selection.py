"""Which images hang together, and which show nothing new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..batch.pair_list import Pair

MIN_MATCHED = 0.5
"""Of the keypoints of the image with fewer, matches by which images are said to show the same."""


def largest_component(pairs: Sequence[Pair]) -> int:
    """Return the number of images in the largest component that pairs connect."""
    components: list[set[str]] = []
    for pair in pairs:
        touched = [names for names in components if not names.isdisjoint(pair)]
        components = [names for names in components if names.isdisjoint(pair)]
        components.append(set(pair).union(*touched))
    return max(map(len, components), default=0)


def motion(first: np.ndarray, second: np.ndarray, matches: np.ndarray) -> float:
    """Return how far most matched keypoints are from their partners, in pixels; infinite in doubt.

    Keypoints are (N, 2) and (M, 2) pixels of two images, matches (K, 2) rows of both. Few of them
    may be of what stands still in the frame, as a bonnet or a time that is shown.
    """
    if len(matches) < MIN_MATCHED * min(len(first), len(second)):
        return np.inf
    return float(np.median(np.linalg.norm(second[matches[:, 1]] - first[matches[:, 0]], axis=1)))


def thin_out(
    names: Sequence[str], near: Mapping[Pair, float], dropped: Mapping[str, str] = {}
) -> dict[str, str]:
    """Leave out images that are near to one before them that is kept, and return that one, too.

    Args:
        names: in their order.
        near: pairs that are too near to each other, with their distance.
        dropped: what was left out before; what it is near to is kept.
    """
    partners: dict[str, dict[str, float]] = {name: {} for name in names}
    for (first, second), distance in near.items():
        partners[first][second] = partners[second][first] = distance
    needed = {*dropped.values()}
    kept: dict[str, None] = {}
    found = {}
    for name in names:
        before = kept.keys() & partners[name]
        if before and name not in needed:
            found[name] = min(before, key=partners[name].__getitem__)
        else:
            kept[name] = None
    return found
