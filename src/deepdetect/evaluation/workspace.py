"""What all benchmarks share: data, methods, cache, progress, and the list of what was left out."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import DeepDetectError
from ..datasets.types import PlanarPair
from ..io.image import load_image
from .baselines import Method
from .cache import Arrays, CacheError, StageCache, file_digest
from .stages import (
    FoundFeatures,
    FoundMatches,
    MatchSettings,
    find_keypoints,
    find_matches,
    versions,
)


@dataclass(eq=False)
class Workspace:
    """The surroundings of a benchmark.

    Attributes:
        data: folder of the data sets, or of the only one that is needed.
        cache: of the stages.
        done: called with a number of finished steps and what is worked on next.
        left_out: what could not be measured, each with the reason.
        run: a number of this run: times are compared within one only.
    """

    data: Path
    cache: StageCache = field(default_factory=lambda: StageCache(None))
    done: Callable[[int, str], object] = lambda steps, text: None
    left_out: list[str] = field(default_factory=list)
    run: int = field(default_factory=time.time_ns)

    def folder(self, name: str) -> Path:
        """Return the folder of a data set: below `data`, or `data` itself."""
        below = self.data / name
        return below if below.is_dir() else self.data

    def keypoints(self, method: Method, image: Path) -> FoundFeatures:
        """Find the keypoints of an image."""
        return find_keypoints(self.cache, method, image)

    def matches(self, method: Method, pair: PlanarPair, settings: MatchSettings) -> FoundMatches:
        """Match a pair."""
        return find_matches(self.cache, method, (pair.first, pair.second), settings)

    def metric(
        self,
        name: str,
        method: Method,
        images: tuple[Path, ...],
        depends: Mapping[str, Any],
        make: Callable[[], Arrays],
    ) -> Arrays:
        """Find a metric's values in the cache, or make them.

        Args:
            name: of the metric; with a number that is raised when its meaning changes.
            method: whose keypoints or matches are judged.
            images: the files that it is taken from.
            depends: what else it depends on, as plain values.
            make: makes them.
        """
        key = {
            "metric": name,
            "method": method.name,
            "version": method.version,
            "images": [file_digest(image) for image in images],
            **depends,
            **versions(),
        }
        return self.cache.get("metrics", key, make)

    def attempt(self, what: str, work: Callable[..., Any], *arguments: Any) -> Any:
        """Do a piece of work; when it fails, note what is left out and why, and return None."""
        try:
            return work(*arguments)
        except CacheError:
            raise
        except Exception as error:  # whatever a detector from outside may raise
            reason = str(error).splitlines()[0] if str(error) else "it failed"
            if not isinstance(error, DeepDetectError):
                reason = f"{reason} ({type(error).__name__})"
            self.left_out.append(f"{what}: {reason}")
            return None


def matrix_key(matrix: np.ndarray) -> str:
    """Return a digest of a matrix, for the cache."""
    return hashlib.sha256(np.ascontiguousarray(matrix, np.float64).tobytes()).hexdigest()[:16]


def image_size(path: Path) -> tuple[int, int]:
    """Return the (width, height) of an image's file."""
    height, width = load_image(path).shape[:2]
    return width, height
