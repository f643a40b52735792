"""Run benchmarks: find data sets, cache results of stages, and record failures."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from deepdetect._shared.errors import DeepDetectError, OptionError, first_line
from deepdetect._shared.opencv import cv2
from deepdetect._shared.progress import progress
from deepdetect._shared.records import file_digest, key, load_arrays, save_arrays
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.io.image import load_image
from deepdetect.matching.pipeline import check_memory

from .baselines.method import LocalFeature
from .profiling import profiled
from .report import Row, Rows

Result = TypeVar("Result")

STAGES: dict[str, tuple[int, tuple[str, ...]]] = {
    "keypoints": (2, ()),
    "matches": (2, ("keypoints",)),
    "guided": (8, ("keypoints",)),
    "stereo": (5, ()),
    "repeatability_paper": (1, ("keypoints",)),
    "repeatability_mutual_nn": (1, ("keypoints",)),
    "corner_errors": (1, ("matches",)),
    "pose": (9, ("matches", "guided")),
    "sfm": (4, ()),
}
"""Version of each stage whose results are cached, and the stages that it builds on. Increase the
version whenever the code's results change, or the cache would return outdated results."""

RECENT_IMAGES = 8


class CacheError(DeepDetectError):
    """A result cannot be cached, because the folder is not writable."""


@dataclass(frozen=True)
class MatchSettings:
    """How the descriptors of two images are matched.

    `matcher` matches descriptors with Euclidean distance; binary ones are always matched exactly by
    Hamming distance. If `budget` is set, only the `budget` best keypoints per image are matched.
    """

    matcher: str = "flann"
    ratio: float = 0.99
    mutual: bool = False
    budget: int | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class PairMatches:
    """The M matches of two images: `points0[i]` matches `points1[i]`, (M, 2) positions each.

    `keypoints0` and `keypoints1` are the positions of all keypoints that the matcher got. `seconds`
    is the time that describing and matching took when the matches were computed.
    """

    points0: np.ndarray
    points1: np.ndarray
    keypoints0: np.ndarray
    keypoints1: np.ndarray
    seconds: float


class Run:
    """A run of benchmarks.

    Args:
        data: folder with a subfolder for each data set, or the folder of the only data set needed.
        cache: folder that keeps the results of stages; old files are never removed. None: no cache.
        quiet: show no progress bars.

    Attributes:
        made: number of results that were computed instead of being read from the cache.
        skipped, failures: as in `Report`.
    """

    def __init__(self, data: Path, cache: Path | None = None, quiet: bool = True) -> None:
        self.data, self.cache, self.quiet = data, cache, quiet
        self.made = 0
        self.skipped: list[str] = []
        self.failures: list[str] = []
        self._recent: OrderedDict[str, tuple[Keypoints, float]] = OrderedDict()
        self._described: tuple[str, list[np.ndarray], float] | None = None

    def folder(self, name: str) -> Path:
        """Return the folder of a data set: a subfolder of `data`, or `data` itself."""
        below = self.data / name
        return below if below.is_dir() else self.data

    @cached_property
    def files_folder(self) -> Path:
        """Folder for generated images: the cache folder; without a cache, a temporary folder."""
        if self.cache is not None:
            return self.cache
        folder = Path(tempfile.mkdtemp(prefix="deepdetect-benchmark-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return folder

    def attempt(self, name: str, work: Callable[..., Result], *arguments: Any) -> Result | None:
        """Return what `work` returns for these arguments; if it fails, record why and return None.

        Errors of data, of external detectors and of OpenCV are recorded. Other errors are raised,
        because they mean that the cache is unusable or that there is a bug. An OptionError is a
        bug, because all options are checked before the run.
        """
        try:
            return work(*arguments)
        except (CacheError, OptionError):
            raise
        except (DeepDetectError, cv2.error) as error:
            reason = getattr(error, "err", None) or error  # `err` lacks OpenCV's file names
            self.fail(f"{name}: {first_line(reason)}")
            return None

    def fail(self, reason: str) -> None:
        """Record that a requested measurement has failed, with the reason."""
        self.skipped.append(reason)
        self.failures.append(reason)

    def rows(
        self,
        what: str,
        methods: Sequence[Any],
        items: Mapping[str, Any],
        measure: Callable[[Any, Any], Row],
    ) -> Rows:
        """Measure each method on each item, for example an image pair; return a row for each.

        `items` is keyed by name. A row holds the names as "method" and "item", and the values that
        `measure(method, item)` returns. Failed measurements are recorded and have no row. `what`,
        for example "matches of ", begins the names of measurements in progress bar and failures.
        """
        rows: Rows = []
        with progress(len(methods) * len(items), "benchmark", "task", self.quiet) as bar:
            for method in methods:
                for name, item in items.items():
                    task = f"{what}{getattr(method, 'title', method.name)} on {name}"
                    bar.set_postfix_str(task, refresh=False)
                    values = self.attempt(task, measure, method, item)
                    if values is not None:
                        rows.append({"method": method.name, "item": name, **values})
                    bar.update(1)
        return rows

    def cached(self, stage: str, depends: object, make: Callable[[], Row]) -> Row:
        """Read a result of one of `STAGES` from the cache, or else compute and cache it.

        A result maps names to arrays, numbers or texts. `depends` holds all inputs of a result,
        which identify it. A path in `depends` stands for the content of its file.
        """
        path = None
        kept: Mapping[str, np.ndarray] | None = None
        if self.cache is not None:
            path = self.cache / stage / f"{key(stage_versions(stage), depends)}.npz"
            kept = load_arrays(path)
        if kept is None:
            kept = {name: np.asarray(value) for name, value in make().items()}
            self.made += 1
            if path is not None:
                try:
                    save_arrays(path, kept)
                except DeepDetectError as error:
                    raise CacheError(str(error)) from None
        return {name: value if value.ndim else value.item() for name, value in kept.items()}

    def keypoints(self, feature: LocalFeature, image: Path) -> tuple[Keypoints, float]:
        """Return an image's keypoints and the seconds of detection, from the cache if possible."""
        name = f"{feature.detection} {file_digest(image)}"
        if name not in self._recent:
            self._recent[name] = self._keypoints(feature, image)
        self._recent.move_to_end(name)
        if len(self._recent) > RECENT_IMAGES:
            self._recent.popitem(last=False)
        return self._recent[name]

    def _keypoints(self, feature: LocalFeature, image: Path) -> tuple[Keypoints, float]:
        def make() -> Row:
            rgb = load_image(image)
            with profiled() as profile:
                found = feature.detect(rgb)
            known = {name: value for name, value in vars(found).items() if value is not None}
            return {**known, "seconds": profile.seconds}

        kept = self.cached("keypoints", (feature.detection, image), make)
        seconds = kept.pop("seconds")
        width, height = kept.pop("image_size").tolist()
        return Keypoints(image_size=(width, height), **kept), seconds

    def matches(
        self, feature: LocalFeature, images: tuple[Path, Path], settings: MatchSettings
    ) -> PairMatches:
        """Return the matches of two images, from the cache if they are there."""
        both = [self.keypoints(feature, image)[0] for image in images]
        if settings.budget is not None:
            both = [keypoints.best(settings.budget) for keypoints in both]

        def make() -> Row:
            check_memory([len(keypoints) for keypoints in both])
            descriptors, describe = self._descriptors(feature, images, both)
            matcher = get_matcher("hamming" if feature.binary else settings.matcher)
            with profiled() as profile:
                found = match_descriptors(
                    descriptors[0],
                    descriptors[1],
                    matcher,
                    ratio=settings.ratio,
                    mutual=settings.mutual,
                    seed=settings.seed,
                    positions=(both[0].xy, both[1].xy),
                )
            seconds = describe + profile.seconds
            return {"rows0": found.indices0, "rows1": found.indices1, "seconds": seconds}

        kept = self.cached("matches", (*feature.key, images, settings), make)
        points = both[0].xy[kept["rows0"]], both[1].xy[kept["rows1"]]
        return PairMatches(*points, both[0].xy, both[1].xy, kept["seconds"])

    def _descriptors(
        self, feature: LocalFeature, images: tuple[Path, Path], both: Sequence[Keypoints]
    ) -> tuple[list[np.ndarray], float]:
        """Return descriptors of two images and the seconds taken; keep them for the next call."""
        name = key(*feature.key, images, [len(keypoints) for keypoints in both])
        if self._described is None or self._described[0] != name:
            self._described = None  # frees the old descriptors before new ones are computed
            rgb = [load_image(image) for image in images]
            with profiled() as profile:
                descriptors = [
                    feature.describe(pixels, keypoints)
                    for pixels, keypoints in zip(rgb, both, strict=True)
                ]
            self._described = name, descriptors, profile.seconds
        return self._described[1:]


def stage_versions(stage: str) -> dict[str, Any]:
    """Return the versions of a stage, of all stages that it builds on, and of NumPy and OpenCV."""
    version, sources = STAGES[stage]
    versions = {"numpy": np.__version__, "opencv": cv2.__version__, stage: version}
    for source in sources:
        versions |= stage_versions(source)
    return versions
