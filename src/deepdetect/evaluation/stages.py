"""The stages of a benchmark: keypoints of an image, matches of a pair; both cached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .._shared.errors import OptionError
from ..features.keypoints import Keypoints
from ..features.matchers import get_matcher, match_descriptors
from ..io.image import load_image
from ..matching.pipeline import check_memory
from .baselines import Method
from .cache import StageCache, file_digest, source_digest
from .metering import Meter, metered


@dataclass(frozen=True)
class MatchSettings:
    """How the descriptors of a pair are matched.

    Attributes:
        matcher: of Euclid's distances; binary descriptors are matched by Hamming's, exactly.
        ratio: the ratio test keeps matches strictly under it.
        mutual: keep only pairs that are each other's nearest.
        budget: the best so many keypoints of each image take part; None: all.
        seed: of a matcher that is random.
    """

    matcher: str = "flann"
    ratio: float = 0.99
    mutual: bool = False
    budget: int | None = None
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Timed:
    """What a stage made, with what it took when it was made."""

    seconds: float
    memory: int


@dataclass(frozen=True, eq=False)
class FoundFeatures(Timed):
    """The keypoints of an image."""

    features: Keypoints


@dataclass(frozen=True, eq=False)
class FoundMatches(Timed):
    """The matches of a pair.

    Attributes:
        points0, points1: (M, 2) float32 matched positions.
        keypoints0, keypoints1: all keypoints that took part, (N0, 2) and (N1, 2).
        describing: seconds and bytes of the descriptors; the others are those of matching.
    """

    points0: np.ndarray
    points1: np.ndarray
    keypoints0: np.ndarray
    keypoints1: np.ndarray
    describing: Timed

    def __len__(self) -> int:
        return len(self.points0)


def find_keypoints(cache: StageCache, method: Method, image: Path) -> FoundFeatures:
    """Find the keypoints of an image, or read them from the cache."""

    def make() -> dict[str, np.ndarray]:
        rgb = load_image(image)
        with metered() as meter:
            features = method.detect(rgb)
        return {**_packed(features), **_meter_arrays("detect", meter)}

    key = {"detection": method.detection, "image": file_digest(image), **versions()}
    found = cache.get("keypoints", key, make)
    return FoundFeatures(*_meter(found, "detect"), _unpacked(found))


def find_matches(
    cache: StageCache, method: Method, images: tuple[Path, Path], settings: MatchSettings
) -> FoundMatches:
    """Match two images, or read their matches from the cache."""
    both = [find_keypoints(cache, method, image).features for image in images]
    if settings.budget is not None:
        both = [features.best(settings.budget) for features in both]

    def make() -> dict[str, np.ndarray]:
        check_memory([len(features) for features in both])
        rgb = [load_image(image) for image in images]
        with metered() as describing:
            descriptors = [
                method.describe(pixels, features)
                for pixels, features in zip(rgb, both, strict=True)
            ]
        for name, features, rows in zip(images, both, descriptors, strict=True):
            if len(rows) != len(features):
                raise OptionError(
                    f"{method.name} made {len(rows)} descriptors of {len(features)} keypoints "
                    f"in {name}: there must be one for each"
                )
        matcher = get_matcher("hamming" if method.binary else settings.matcher)
        with metered() as matching:
            found = match_descriptors(
                *descriptors,
                matcher,
                ratio=settings.ratio,
                mutual=settings.mutual,
                seed=settings.seed,
                positions=(both[0].xy, both[1].xy),
            )
        return {
            "rows0": found.rows0,
            "rows1": found.rows1,
            **_meter_arrays("describe", describing),
            **_meter_arrays("match", matching),
        }

    key = {
        "method": method.name,
        "version": method.version,
        "images": [file_digest(image) for image in images],
        "settings": vars(settings),
        **versions(),
    }
    found = cache.get("matches", key, make)
    return FoundMatches(
        *_meter(found, "match"),
        both[0].xy[found["rows0"]],
        both[1].xy[found["rows1"]],
        both[0].xy,
        both[1].xy,
        Timed(*_meter(found, "describe")),
    )


def versions() -> dict[str, Any]:
    """Return what all results depend on, for the keys of the cache."""
    return {"sources": source_digest(), "opencv": cv2.__version__, "numpy": np.__version__}


def _packed(features: Keypoints) -> dict[str, np.ndarray]:
    """Store positions on whole pixels as such: they are most of a cache."""
    small = bool((np.abs(features.xy) < 2**15).all())
    whole = features.xy.astype(np.int16) if small else features.xy
    exact = (whole == features.xy).all()
    arrays = {
        "xy": whole if exact else features.xy,
        "scores": features.scores,
        "image_size": np.array(features.image_size),
    }
    for name in ("sizes", "angles", "octaves", "descriptors"):
        if (part := getattr(features, name)) is not None:
            arrays[name] = part
    return arrays


def _unpacked(arrays: Mapping[str, np.ndarray]) -> Keypoints:
    width, height = arrays["image_size"].tolist()
    optional = {name: arrays.get(name) for name in ("sizes", "angles", "octaves", "descriptors")}
    return Keypoints(arrays["xy"], arrays["scores"], (width, height), **optional)


def _meter_arrays(stage: str, meter: Meter) -> dict[str, np.ndarray]:
    return {f"{stage}_meter": np.array([meter.seconds, meter.memory], np.float64)}


def _meter(arrays: Mapping[str, np.ndarray], stage: str) -> tuple[float, int]:
    seconds, memory = arrays[f"{stage}_meter"].tolist()
    return seconds, int(memory)
