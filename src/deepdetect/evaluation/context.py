"""What all protocols share: data, cached keypoints and matches, the list of what was skipped."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import DeepDetectError, OptionError
from ..features.keypoints import Keypoints
from ..features.matchers import get_matcher, match_descriptors
from ..io.image import load_image
from ..matching.unguided import check_memory
from .baselines.method import BaselineError, LocalFeature
from .cache import Arrays, CacheError, StageCache, file_digest
from .profiling import Profile, profiled

OPTIONAL = ("logits", "sizes", "angles", "octaves", "descriptors")
"""Columns that keypoints may have."""

RECENT_IMAGES = 8
"""Images whose keypoints are kept in memory."""


@dataclass(frozen=True)
class MatchSettings:
    """How the descriptors of a pair are matched.

    Attributes:
        matcher: for Euclid's distances; binary descriptors are matched by Hamming's, exactly.
        ratio: the ratio test keeps matches strictly under it.
        mutual: keep only mutual nearest neighbours.
        budget: only the best this many keypoints of each image are matched; None: all.
        seed: of a matcher that is random.
    """

    matcher: str = "flann"
    ratio: float = 0.99
    mutual: bool = False
    budget: int | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ImageKeypoints:
    """The keypoints of an image, and what detecting them took when it was done."""

    features: Keypoints
    profile: Profile


@dataclass(frozen=True, eq=False)
class PairMatches:
    """The matches of a pair.

    Attributes:
        points0, points1: (M, 2) float32 matched positions.
        keypoints0, keypoints1: all keypoints that were matched, (N0, 2) and (N1, 2).
        describe, match: what describing both images and matching took when it was done.
    """

    points0: np.ndarray
    points1: np.ndarray
    keypoints0: np.ndarray
    keypoints1: np.ndarray
    describe: Profile
    match: Profile

    def __len__(self) -> int:
        return len(self.points0)


@dataclass(eq=False)
class BenchmarkContext:
    """The surroundings of a benchmark.

    Attributes:
        data: folder of the data sets, or of the only one that is needed.
        cache: of the stages.
        skipped: what was not measured, each with the reason.
        failures: of that, what was wanted and could not be measured.
    """

    data: Path
    cache: StageCache = field(default_factory=lambda: StageCache(None))
    skipped: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    _temporary: Path | None = field(default=None, init=False, repr=False)
    _recent: OrderedDict[tuple[str, str], ImageKeypoints] = field(
        default_factory=OrderedDict, init=False, repr=False
    )
    _described: tuple[Any, list[np.ndarray], Profile] | None = field(
        default=None, init=False, repr=False
    )

    def folder(self, name: str) -> Path:
        """Return the folder of a data set: below `data`, or `data` itself."""
        below = self.data / name
        return below if below.is_dir() else self.data

    def files_folder(self) -> Path:
        """Return a folder for images that are made: in the cache's, or a temporary one."""
        if self.cache.folder is not None:
            return self.cache.folder
        if self._temporary is None:
            self._temporary = Path(tempfile.mkdtemp(prefix="deepdetect-benchmark-"))
            weakref.finalize(self, shutil.rmtree, self._temporary, ignore_errors=True)
        return self._temporary

    def try_run(self, name: str, work: Callable[[], Any]) -> Any:
        """Do a piece of work; when it cannot be done, note that it is skipped and why.

        Only errors of data and of detectors from outside are noted. Any other is a bug and passes,
        an error of options too: those of the user were checked before the run.

        Returns:
            Its result, or None.
        """
        try:
            return work()
        except (CacheError, OptionError):
            raise
        except DeepDetectError as error:
            self.fail(f"{name}: {error}")
            return None

    def fail(self, reason: str) -> None:
        """Note what was wanted and cannot be measured."""
        self.skipped.append(reason)
        self.failures.append(reason)

    def keypoints(self, feature: LocalFeature, image: Path) -> ImageKeypoints:
        """Find the keypoints of an image, or read them from the cache."""
        recent = (feature.detection, file_digest(image))
        if recent not in self._recent:
            self._recent[recent] = self._keypoints(feature, image)
        self._recent.move_to_end(recent)
        if len(self._recent) > RECENT_IMAGES:
            self._recent.popitem(last=False)
        return self._recent[recent]

    def _keypoints(self, feature: LocalFeature, image: Path) -> ImageKeypoints:
        def make() -> Arrays:
            rgb = load_image(image)
            with profiled() as profile:
                features = feature.detect(rgb)
            return {**_pack(features), **pack_profile("detect", profile)}

        key = {"detection": feature.detection, "image": file_digest(image)}
        found = self.cache.get("keypoints", key, make)
        return ImageKeypoints(_unpack(found), unpack_profile("detect", found))

    def matches(
        self, feature: LocalFeature, images: tuple[Path, Path], settings: MatchSettings
    ) -> PairMatches:
        """Match two images, or read their matches from the cache."""
        both = [self.keypoints(feature, image).features for image in images]
        if settings.budget is not None:
            both = [features.best(settings.budget) for features in both]

        def make() -> Arrays:
            check_memory([len(features) for features in both])
            descriptors, describe = self._descriptors(feature, images, both)
            matcher = get_matcher("hamming" if feature.binary else settings.matcher)
            with profiled() as match:
                found = match_descriptors(
                    descriptors[0],
                    descriptors[1],
                    matcher,
                    ratio=settings.ratio,
                    mutual=settings.mutual,
                    seed=settings.seed,
                    positions=(both[0].xy, both[1].xy),
                )
            return {
                "rows0": found.indices0,
                "rows1": found.indices1,
                **pack_profile("describe", describe),
                **pack_profile("match", match),
            }

        key = {**feature_key(feature, images), "settings": vars(settings)}
        found = self.cache.get("matches", key, make)
        return PairMatches(
            both[0].xy[found["rows0"]],
            both[1].xy[found["rows1"]],
            both[0].xy,
            both[1].xy,
            unpack_profile("describe", found),
            unpack_profile("match", found),
        )

    def _descriptors(
        self, feature: LocalFeature, images: tuple[Path, Path], both: Sequence[Keypoints]
    ) -> tuple[list[np.ndarray], Profile]:
        """Describe both images; those of the last pair are kept for other settings of matching."""
        key = (feature_key(feature, images), [len(features) for features in both])
        if self._described is None or self._described[0] != key:
            self._described = None  # frees its memory before more is needed
            rgb = [load_image(image) for image in images]
            with profiled() as profile:
                descriptors = [
                    feature.describe(pixels, features)
                    for pixels, features in zip(rgb, both, strict=True)
                ]
            for image, features, rows in zip(images, both, descriptors, strict=True):
                if len(rows) != len(features):
                    raise BaselineError(
                        f"{feature.name} made {len(rows)} descriptors for {len(features)} "
                        f"keypoints in {image}: there must be one for each"
                    )
            self._described = key, descriptors, profile
        return self._described[1:]

    def metric(
        self,
        stage: str,
        feature: LocalFeature,
        images: tuple[Path, ...],
        depends: Mapping[str, Any],
        make: Callable[[], Arrays],
    ) -> Arrays:
        """Find a metric's values in the cache, or make them.

        Args:
            stage: its name in `cache.STAGES`.
            feature: whose keypoints or matches are evaluated.
            images: the files that it is computed from.
            depends: what else it depends on, as plain values.
            make: makes them.
        """
        return self.cache.get(stage, {**feature_key(feature, images), **depends}, make)


def feature_key(feature: LocalFeature, images: Sequence[Path]) -> dict[str, Any]:
    """Return what results of a feature on images depend on, for the keys of the cache."""
    digests = [file_digest(image) for image in images]
    return {"feature": feature.name, "version": feature.version, "images": digests}


def pack_profile(stage: str, profile: Profile) -> dict[str, np.ndarray]:
    """Return a profile as an array by name, for the cache."""
    return {f"{stage}_profile": np.array([profile.seconds, profile.memory], np.float64)}


def unpack_profile(stage: str, arrays: Arrays) -> Profile:
    """Return the profile of `pack_profile`."""
    seconds, memory = arrays[f"{stage}_profile"].tolist()
    return Profile(seconds, int(memory))


def _pack(features: Keypoints) -> dict[str, np.ndarray]:
    """Store positions on whole pixels as such: they are most of a cache."""
    small = bool((np.abs(features.xy) < 2**15).all())
    whole = features.xy.astype(np.int16) if small else features.xy
    arrays = {
        "xy": whole if (whole == features.xy).all() else features.xy,
        "scores": features.scores,
        "image_size": np.array(features.image_size),
    }
    for name in OPTIONAL:
        if (part := getattr(features, name)) is not None:
            arrays[name] = part
    return arrays


def _unpack(arrays: Arrays) -> Keypoints:
    width, height = arrays["image_size"].tolist()
    optional = {name: arrays.get(name) for name in OPTIONAL}
    return Keypoints(arrays["xy"], arrays["scores"], (width, height), **optional)  # type: ignore[arg-type]
