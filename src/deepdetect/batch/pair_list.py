"""Lists of pairs of images to match, and the names of their groups in files."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

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
