"""Which images are matched with which: lists of pairs, and the names of their groups in files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

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

    A pair that is there twice, or also the other way round, is taken once, as it is there first.

    Raises:
        DeepDetectError: the file is missing or empty, or a line is something else.
    """
    pairs: list[Pair] = []
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise DeepDetectError(f"{path} cannot be read ({reason}): check the file") from None
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        names = line.strip().split("\t") if "\t" in line.strip() else line.split()
        if len(names) != 2 or names[0] == names[1]:
            raise DeepDetectError(
                f"line {number} of {path} is no pair: give the names of two images, with a blank "
                "between, or a tab where they have blanks themselves"
            )
        pairs.append((names[0], names[1]))
    if not pairs:
        raise DeepDetectError(f"{path} has no pairs: give the names of two images on each line")
    return _once_each(pairs)


def sequential_pairs(names: Sequence[str], following: int) -> list[Pair]:
    """Return each name with so many that follow it.

    Example:
        >>> sequential_pairs(["a", "b", "c", "d"], 2)
        [('a', 'b'), ('a', 'c'), ('b', 'c'), ('b', 'd'), ('c', 'd')]
    """
    return [
        (name, other) for k, name in enumerate(names) for other in names[k + 1 : k + 1 + following]
    ]


def check_pairs(pairs: Sequence[Pair]) -> list[Pair]:
    """Return pairs that were given from Python, once each; an OptionError says which is none."""
    for pair in pairs:
        names = () if isinstance(pair, str) else tuple(pair)
        if len(names) != 2 or names[0] == names[1] or not all(names):
            raise OptionError(
                f"{pair!r} in `pairs` is no pair: give (name, name) of two images, or a text file"
            )
    return _once_each([(name0, name1) for name0, name1 in pairs])


def _once_each(pairs: Sequence[Pair]) -> list[Pair]:
    """Leave out pairs that are there before, or the other way round."""
    kept: dict[Pair, None] = {}
    for pair in pairs:
        if pair[::-1] not in kept:
            kept[pair] = None
    return list(kept)
