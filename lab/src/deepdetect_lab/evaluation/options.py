"""Options of the benchmarks, and lists of the local features that each protocol compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from deepdetect._shared.errors import OptionError, check_name
from deepdetect._shared.options import check_ranges, suggest_keywords
from deepdetect.detector.detector import DeepDetect
from deepdetect.detector.heatmap import HeatmapOptions
from deepdetect.features.selection import SelectionOptions

from .baselines.hessian import HESSIAN
from .baselines.method import (
    COMMON_DESCRIPTOR,
    LocalFeature,
    deepdetect_feature,
    points_feature,
    with_common_descriptor,
    with_own_scale,
)
from .baselines.opencv import CLASSICAL, STANDARD
from .baselines.random import all_pixels_feature, random_feature
from .masks import LabelDensityDetector

PROTOCOLS = ("paper", "standard", "guided", "degraded")
DEFAULT_PROTOCOLS = PROTOCOLS[:3]
"""The protocol "degraded" takes four times as long as "standard", because it runs "standard" for
each of four degradations. So it is not a default."""

THRESHOLDS = (0.5, 0.7, 0.8, 0.9)
PAPER_RESOLUTION_PX = 480

BASELINES: dict[str, LocalFeature] = {**CLASSICAL, **HESSIAN}
"""All classical baselines by name: the paper's, and the Hessian ones of the standard protocol."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class BenchmarkOptions:
    """Which methods a benchmark compares, and with which settings.

    Attributes:
        detector: DeepDetect with the weights to evaluate.
        protocols: names from `PROTOCOLS`: what to measure on image pairs with homographies.
        classical: names from `BASELINES`: the classical detectors to compare with.
        others: further local features to compare with, for example external ones.
        channels: order of the colours in DeepDetect's input; the paper's code uses "bgr".
        geometry_weights: names or files of weights; each of them is evaluated on stereo pairs.
        max_pairs: largest number of image pairs per scene. If a scene has more, evenly spaced ones
            are taken. If it is 1, a scene with homographies gives its last pair.
        max_images: largest number of images per scene in structure from motion. If a scene has
            more, the first images of a sequence or evenly spaced other images are taken.
        equal_density: in the paper's protocol, take DeepDetect's N most probable pixels instead of
            all with a probability over 0.5. N is the number of pixels that the image's label
            marks. Without this option, weights that mark more pixels score higher.
        ranker: npz file written by `deepdetect dev train-points`, with the network that ranks
            multi-scale keypoints. None: the bundled file.

    Raises:
        OptionError: a name is unknown, or a number is out of its range.
    """

    detector: DeepDetect
    protocols: tuple[str, ...] = DEFAULT_PROTOCOLS
    classical: tuple[str, ...] = tuple(BASELINES)
    others: tuple[LocalFeature, ...] = ()
    channels: Literal["rgb", "bgr"] = "rgb"
    geometry_weights: tuple[str | Path, ...] = ("dense",)
    max_pairs: int = 60
    max_images: int = 20
    equal_density: bool = False
    ranker: str | Path | None = None

    def __post_init__(self) -> None:
        check_ranges(self, counts=("max_pairs",), between={"max_images": (3, float("inf"))})
        for name in self.protocols:
            check_name("protocol", name, PROTOCOLS)
        for name in self.classical:
            check_name("classical baseline", name, BASELINES)
        stems = [Path(weights).stem for weights in self.geometry_weights]
        if len(set(stems)) < len(stems):
            raise OptionError(
                f"two geometry_weights have the same name ({', '.join(stems)}): rename a file"
            )

    def deepdetect_480(self, threshold: float = 0.5) -> LocalFeature:
        """Return DeepDetect as in the paper: for images of 480x480, with SIFT at a size of 3 px."""
        detector = self.detector.configured(HeatmapOptions(PAPER_RESOLUTION_PX, self.channels))
        title = f"DeepDetect, threshold {threshold:g}"
        name = f"deepdetect-{threshold:g}"
        feature = deepdetect_feature(detector, SelectionOptions(threshold), name=name, title=title)
        if not self.equal_density:
            return feature
        return deepdetect_feature(
            LabelDensityDetector(detector),
            name="deepdetect-equal-density",
            title="DeepDetect, as many pixels as the label",
            version=feature.version,
        )

    def native_detector(self) -> DeepDetect:
        """Return the detector at native image resolution."""
        return self.detector.configured(HeatmapOptions("native", self.channels))

    def deepdetect_native(self) -> LocalFeature:
        """Return DeepDetect at native resolution. Pixels with probability > 0.5 are keypoints."""
        title = "DeepDetect, native resolution, all pixels over 0.5"
        return deepdetect_feature(self.native_detector(), name="deepdetect-native", title=title)

    def chance_baselines(self) -> tuple[LocalFeature, LocalFeature]:
        """Return two baselines: as many random pixels as `deepdetect_480` marks, and all pixels."""
        return random_feature(self.deepdetect_480()), all_pixels_feature()

    def density_features(self) -> list[LocalFeature]:
        """Return the features to compare by density (Table I of the paper) and by repeatability."""
        classical = [CLASSICAL[name] for name in self.classical if name in CLASSICAL]
        thresholds = THRESHOLDS[:1] if self.equal_density else THRESHOLDS
        own = [self.deepdetect_480(threshold) for threshold in thresholds]
        return without_repeats([*classical, *self.others, *own, *self.chance_baselines()])

    def matching_features(self) -> list[LocalFeature]:
        """Return the features of the paper's Table II: detectors with low settings, DeepDetect."""
        low = [CLASSICAL[name] for name in self.classical if name.endswith("-low")]
        own = [self.deepdetect_480(), *self.chance_baselines()]
        return without_repeats([*low, *self.others, *own])

    def standard_features(self) -> list[LocalFeature]:
        """Return the features of the standard protocol; the chance baselines come last."""
        ranked = {**STANDARD, **HESSIAN}
        chosen = [name for name in ranked if name in self.classical]
        # These features are measured twice: with the common descriptor, and with their own.
        systems = {f.name: f for f in self.others if f.name in BASELINES}
        systems |= {name: STANDARD[name] for name in ("sift", "orb") if name in chosen}
        own = deepdetect_feature(
            self.native_detector(),
            SelectionOptions(nms_radius=1, subpixel=True),
            name="deepdetect-sparse",
            title="DeepDetect, pixels by logits, suppression 3x3, sub-pixel",
            descriptor=COMMON_DESCRIPTOR,
        )
        points = points_feature(self.ranker)
        native = self.deepdetect_native()
        chance = [random_feature(native, name="random-native"), all_pixels_feature()]
        features = [with_common_descriptor(ranked[name]) for name in chosen]
        features += [
            replace(f, name=f"{f.name}-own", title=f"{f.title}, own descriptors")
            for f in systems.values()
        ]
        features += [with_own_scale(ranked[name]) for name in chosen if ranked[name].own_scale]
        features += [feature for feature in self.others if feature.name not in BASELINES]
        features += [with_common_descriptor(points), with_own_scale(points), own]
        features += [with_common_descriptor(feature) for feature in (native, *chance)]
        return without_repeats(features)


def without_repeats(features: Sequence[LocalFeature]) -> list[LocalFeature]:
    """Drop repetitions of a feature; raise an OptionError if different features share a name."""
    by_name: dict[str, LocalFeature] = {}
    for feature in features:
        if by_name.setdefault(feature.name, feature).version != feature.version:
            raise OptionError(f"two methods are named {feature.name}: rename one of their files")
    return list(by_name.values())
