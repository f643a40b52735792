"""Find which images are connected by matches, and which show nothing new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..batch.pair_list import Pair

MIN_MATCHED = 0.5
"""Two images can count as nearly the same only if, in the image with fewer keypoints, at least this
fraction of the keypoints is matched. Chosen by hand."""


def largest_component(pairs: Sequence[Pair]) -> int:
    """Return the number of images in the largest group that pairs connect, directly or not."""
    components: list[set[str]] = []
    for pair in pairs:
        touched = [names for names in components if not names.isdisjoint(pair)]
        components = [names for names in components if names.isdisjoint(pair)]
        components.append(set(pair).union(*touched))
    return max(map(len, components), default=0)


def motion(first: np.ndarray, second: np.ndarray, matches: np.ndarray) -> float:
    """Return the median motion of matched keypoints in pixels, or infinity if few are matched.

    `first` (N, 2) and `second` (M, 2) are keypoints in pixels, `matches` (K, 2) their indices. If
    there are few matches, most may lie on something fixed to the camera, such as a car's bonnet.
    """
    if len(matches) < MIN_MATCHED * min(len(first), len(second)):
        return np.inf
    return float(np.median(np.linalg.norm(second[matches[:, 1]] - first[matches[:, 0]], axis=1)))


def thin_out(
    names: Sequence[str], near: Mapping[Pair, float], dropped: Mapping[str, str] = {}
) -> dict[str, str]:
    """Return the images to leave out, each with the earlier image that is kept in its place.

    Args:
        names: all images in order.
        near: pairs of images that show nearly the same, with the motion between them in pixels.
        dropped: images left out earlier, each with the image kept in its place, which stays kept.
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
