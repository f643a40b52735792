"""Results of stages on disk, so that a second run does only the new work."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError

Arrays = Mapping[str, np.ndarray]


UNRELATED = frozenset(
    {
        *("cli", "training", "pictures.py", "progress.py", "provenance.py", "stereo_demo.py"),
        *(
            f"benchmark/{name}"
            for name in (
                *("formats", "cache.py", "charts.py", "paper_figures.py", "paper_numbers.py"),
                *("registry.py", "report.py", "run.py", "refine_oxford.py", "planar_sections.py"),
                *("standard_tables.py", "oxford.py", "hpatches.py", "low_visibility.py"),
            )
        ),
    }
)
"""Packages and modules that no cached result goes through: command line, drawing, writing."""

NAMES = "names of the arrays"
"""Key of the list of all others, by which a file that lost some is known."""


class CacheError(DeepDetectError):
    """A result cannot be kept: the folder cannot be written."""


class StageCache:
    """Arrays by what they were made of.

    A result is kept under the digest of its stage and of all that it depends on; when one of
    these changes it is made anew. A damaged file is made anew too. Old files are never removed:
    delete the folder to free its room.

    Args:
        folder: where the files are; None keeps nothing.

    Attributes:
        made: number of results that were made, not found.

    Example:
        >>> cache = StageCache(None)
        >>> cache.get("sum", {"of": [1, 2]}, lambda: {"value": np.array(3)})["value"].item()
        3
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.made = 0

    def get(self, stage: str, key: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
        """Find a result, or make and keep it.

        Args:
            stage: name of the stage, as "keypoints".
            key: all that the result depends on, as plain values.
            make: makes the arrays.

        Raises:
            CacheError: the result cannot be written.
        """
        if self.folder is None:
            made = make()
            self.made += 1
            return made
        text = json.dumps(key, sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:32]
        path = self.folder / stage / f"{digest}.npz"
        found = _read(path)
        if found is not None:
            return found
        arrays = dict(make())
        self.made += 1
        try:
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.savez_compressed(file, **arrays, **{NAMES: np.array(sorted(arrays))})
        except DeepDetectError as error:
            raise CacheError(str(error)) from None
        return arrays


def _read(path: Path) -> Arrays | None:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = dict(file)
        names = arrays.pop(NAMES).tolist()
    except Exception:  # damage shows as any of a dozen errors of zip, zlib and numpy
        return None
    return arrays if sorted(arrays) == names else None


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file; it is read once in a process, and when it has changed."""
    state = path.stat()
    return _digest(path.resolve(), state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Return a digest of the package's own sources but for `UNRELATED`.

    A result that was made by other code is not used: no number that is raised by hand is forgotten.
    """
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        inside = path.relative_to(root)
        if UNRELATED.isdisjoint(part.as_posix() for part in (inside, *inside.parents)):
            digest.update(inside.as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=4096)
def _digest(path: Path, changed: int, size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
