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
from .._shared.opencv import cv2

Arrays = Mapping[str, np.ndarray]

STAGES: dict[str, tuple[int, tuple[str, ...]]] = {
    "keypoints": (1, ()),
    "matches": (1, ("keypoints",)),
    "guided": (4, ("keypoints",)),
    "stereo": (1, ()),
    "repeatability_paper": (1, ("keypoints",)),
    "repeatability_mutual_nn": (1, ("keypoints",)),
    "coverage": (1, ("keypoints",)),
    "corner_errors": (1, ("matches",)),
    "pose": (1, ("matches", "guided")),
    "foreground": (1, ("keypoints",)),
    "sfm": (1, ()),
}
"""Version of each stage, and the stages it is made from.

Raise the version when a change of the code changes the stage's results: cached ones of another
version are not used, nor what was made from them.
"""

NAMES = "names of the arrays"
"""Key of the list of all others, by which a file that lost some is recognised."""


class CacheError(DeepDetectError):
    """A result cannot be kept: the folder cannot be written."""


class StageCache:
    """Arrays by what they were made from.

    A result is kept under the digest of its stage, of the stage's version and of all that it
    depends on; when one of these changes it is computed again, and so it is when its file is
    damaged. Old files are never removed: delete the folder to free its space.

    Args:
        folder: where the files are; None keeps nothing.

    Attributes:
        made: number of results that were computed, not found.

    Example:
        >>> cache = StageCache(None)
        >>> cache.get("matches", {"of": [1, 2]}, lambda: {"value": np.array(3)})["value"].item()
        3
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.made = 0

    def get(self, stage: str, key: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
        """Find a result, or make and keep it.

        Args:
            stage: one of `STAGES`.
            key: all that the result depends on, as plain values.
            make: makes the arrays.

        Raises:
            CacheError: the result cannot be written.
        """
        if self.folder is None:
            made = make()
            self.made += 1
            return made
        text = json.dumps({**key, **stage_versions(stage)}, sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:32]
        path = self.folder / stage / f"{digest}.npz"
        found = _read(path)
        if found is not None:
            return found
        arrays = dict(make())
        self.made += 1
        try:
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                contents: dict[str, Any] = {**arrays, NAMES: np.array(sorted(arrays))}
                np.savez_compressed(file, **contents)
        except DeepDetectError as error:
            raise CacheError(str(error)) from None
        return arrays


def stage_versions(stage: str) -> dict[str, Any]:
    """Return the versions that a stage's results depend on: its own, its sources', the packages'.

    Example:
        >>> sorted(stage_versions("matches"))
        ['keypoints', 'matches', 'numpy', 'opencv']
    """
    version, sources = STAGES[stage]
    versions = {"numpy": np.__version__, "opencv": cv2.__version__, stage: version}
    for source in sources:
        versions |= stage_versions(source)
    return versions


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


@lru_cache(maxsize=4096)
def _digest(path: Path, changed: int, size: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def matrix_digest(matrix: np.ndarray) -> str:
    """Return a digest of a matrix's numbers."""
    return hashlib.sha256(np.ascontiguousarray(matrix, np.float64).tobytes()).hexdigest()[:16]
