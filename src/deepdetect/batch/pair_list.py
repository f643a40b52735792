"""Lists of pairs of images to match, the names of their groups in files, and what pairs connect."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .._shared.atomic import write_whole
from .._shared.errors import DeepDetectError, MissingFileError, OptionError

Pair = tuple[str, str]


def pair_name(name0: str, name1: str) -> str:
    """Return the path of a pair's group in a file of matches, as in hloc.

    Example:
        >>> pair_name("db/1.jpg", "query/2.jpg")
        'db-1.jpg/query-2.jpg'
    """
    return "/".join(name.replace("/", "-") for name in (name0, name1))


def read_pairs(path: str | Path) -> list[Pair]:
    """Read a list of pairs: two image names on each line, separated by blanks or by a tab.

    If a pair is listed twice, in either order, only the first one counts.

    Raises:
        DeepDetectError: the file is missing or empty, or a line does not name two images.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MissingFileError(
            f"there is no file {path}: give a file or one of 'exhaustive', 'sequential:10', "
            "'similar:20'"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise DeepDetectError(f"{path} cannot be read ({reason}): check the file") from None
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        raise DeepDetectError(f"{path} has no pairs: give the names of two images on each line")
    return check_pairs([line.split("\t" if "\t" in line else None) for line in lines], str(path))


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    """Write a list of pairs that `read_pairs` can read, and also hloc if no name has blanks."""
    blanks = any(" " in name for pair in pairs for name in pair)
    lines = [("\t" if blanks else " ").join(pair) + "\n" for pair in pairs]
    write_whole(path, "".join(lines))


SIMILAR = 20
"""The choice "similar" matches each image with this many others. Chosen by hand."""


def similar(pairs: object) -> int | None:
    """Return N if `pairs` is "similar:N", `SIMILAR` if it is "similar", and None otherwise."""
    match = isinstance(pairs, str) and re.fullmatch("similar(?::([1-9][0-9]{0,8}))?", pairs)
    return int(match[1] or SIMILAR) if match else None


def following(pairs: object) -> int | None:
    """Return N if `pairs` is "sequential:N", a huge number if "exhaustive", and None otherwise."""
    match = isinstance(pairs, str) and re.fullmatch("sequential:([1-9][0-9]{0,8})", pairs)
    return sys.maxsize if pairs == "exhaustive" else int(match[1]) if match else None


def list_pairs(pairs: str | Path | Sequence[Sequence[str]], names: Sequence[str]) -> list[Pair]:
    """Return the pairs of images that a choice selects.

    The choice `pairs` is "exhaustive" (all pairs of `names`), "sequential:N" (each name with the N
    that follow it), a list of pairs of names, or a text file with a pair on each line.

    Example:
        >>> list_pairs("sequential:2", ["a", "b", "c", "d"])
        [('a', 'b'), ('a', 'c'), ('b', 'c'), ('b', 'd'), ('c', 'd')]
    """
    count = following(pairs)
    if count is None:
        return read_pairs(pairs) if isinstance(pairs, str | Path) else check_pairs(pairs)
    return [(name, other) for k, name in enumerate(names) for other in names[k + 1 :][:count]]


def check_pairs(pairs: Sequence[Sequence[str]], place: str = "`pairs`") -> list[Pair]:
    """Return pairs without repetitions in either order; raise an OptionError for a wrong pair."""
    kept: dict[Pair, None] = {}
    for pair in pairs:
        if isinstance(pair, str) or len(pair) != 2 or pair[0] == pair[1] or not all(pair):
            raise OptionError(
                f"{pair!r} in {place} is not a pair: give the names of two images; in a text file, "
                "put both on one line, separated by a blank, or by a tab if names have blanks"
            )
        if (pair[1], pair[0]) not in kept:
            kept[pair[0], pair[1]] = None
    return list(kept)


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
