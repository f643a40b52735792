"""Which images are matched with which: lists of pairs, and the names of their groups in files."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, MissingFileError, OptionError

Pair = tuple[str, str]


def pair_name(name0: str, name1: str) -> str:
    """Return the path of a pair's group in a file of matches, as hloc makes it.

    Example:
        >>> pair_name("db/1.jpg", "query/2.jpg")
        'db-1.jpg/query-2.jpg'
    """
    return "/".join(name.replace("/", "-") for name in (name0, name1))


def read_pairs(path: str | Path) -> list[Pair]:
    """Read a list of pairs: two names of images on each line, with a blank or a tab between.

    A pair that is listed twice, in either order, is taken once, as it is listed first.

    Raises:
        DeepDetectError: the file is missing or empty, or a line is something else.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MissingFileError(
            f"there is no file {path}: give one, or exhaustive, or sequential:10"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise DeepDetectError(f"{path} cannot be read ({reason}): check the file") from None
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        raise DeepDetectError(f"{path} has no pairs: give the names of two images on each line")
    return check_pairs([line.split("\t" if "\t" in line else None) for line in lines], str(path))


def write_pairs(path: Path, pairs: Sequence[Pair]) -> None:
    """Write a list of pairs as `read_pairs` and hloc read it."""
    blanks = any(" " in name for pair in pairs for name in pair)
    lines = [("\t" if blanks else " ").join(pair) + "\n" for pair in pairs]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


SIMILAR = 20
"""Most similar images that each one is matched with, where no number is told."""


def similar(pairs: object) -> int | None:
    """Return with how many of the most similar each image is matched; None where not by these."""
    match = isinstance(pairs, str) and re.fullmatch("similar(?::([1-9][0-9]{0,8}))?", pairs)
    return int(match[1] or SIMILAR) if match else None


def following(pairs: object) -> int | None:
    """Return with how many that follow each image is matched; None where it is told otherwise."""
    match = isinstance(pairs, str) and re.fullmatch("sequential:([1-9][0-9]{0,8})", pairs)
    return sys.maxsize if pairs == "exhaustive" else int(match[1]) if match else None


def list_pairs(pairs: str | Path | Sequence[Sequence[str]], names: Sequence[str]) -> list[Pair]:
    """Return the pairs that are asked for, of images of these names.

    "exhaustive": all; "sequential:N": each image with the N that follow it; or a list of pairs of
    names, or a text file with a pair on each line.

    Example:
        >>> list_pairs("sequential:2", ["a", "b", "c", "d"])
        [('a', 'b'), ('a', 'c'), ('b', 'c'), ('b', 'd'), ('c', 'd')]
    """
    count = following(pairs)
    if count is None:
        return read_pairs(pairs) if isinstance(pairs, str | Path) else check_pairs(pairs)
    return [(name, other) for k, name in enumerate(names) for other in names[k + 1 :][:count]]


def check_pairs(pairs: Sequence[Sequence[str]], place: str = "`pairs`") -> list[Pair]:
    """Return pairs, each once: one that is listed before, in either order, is left out.

    An OptionError says which is no pair.
    """
    kept: dict[Pair, None] = {}
    for pair in pairs:
        if isinstance(pair, str) or len(pair) != 2 or pair[0] == pair[1] or not all(pair):
            raise OptionError(
                f"{pair!r} in {place} is no pair: give the names of two images, in a text file on "
                "a line with a blank between, or a tab where they have blanks themselves"
            )
        if (pair[1], pair[0]) not in kept:
            kept[pair[0], pair[1]] = None
    return list(kept)
