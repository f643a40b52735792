"""What a benchmark is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from .._shared.errors import OptionError, unknown_name
from ..detector.detector import DeepDetect
from ..detector.heatmap import HeatmapOptions
from ..features.selection import SelectionOptions
from .baselines import (
    CLASSICAL,
    COMMON_DESCRIPTOR,
    STANDARD,
    Method,
    deepdetect_method,
    every_pixel_method,
    random_method,
)

PROTOCOLS = ("paper", "standard", "guided")
THRESHOLDS = (0.5, 0.7, 0.8, 0.9)
LOW = ("sift-low", "orb-low", "brisk-low", "fast-low", "agast-low", "harris-low", "shi-tomasi-low")
DEFAULT = ("sift", "orb", "brisk", "fast", "agast", "harris", "shi-tomasi")


@dataclass(frozen=True, eq=False)
class BenchmarkOptions:
    """What is compared, and how.

    Attributes:
        detector: DeepDetect, with the weights that are judged.
        protocols: one or more of "paper", "standard" and "guided".
        classical: names of the classical methods.
        others: further methods.
        channels: order of the colours in the paper's protocol; "bgr" is what the paper's code
            feeds its own weights.
        geometry_weights: the weights for stereo pairs, one or more; time is measured with the
            first.

    Raises:
        OptionError: a name is unknown, or nothing is left to do.
    """

    detector: DeepDetect
    protocols: tuple[str, ...] = PROTOCOLS
    classical: tuple[str, ...] = (*DEFAULT, *LOW)
    others: tuple[Method, ...] = ()
    channels: str = "rgb"
    geometry_weights: tuple[str | Path, ...] = ("dense",)

    def __post_init__(self) -> None:
        for protocol in self.protocols:
            if protocol not in PROTOCOLS:
                raise unknown_name("protocol", protocol, PROTOCOLS)
        if not self.geometry_weights:
            raise OptionError("name the weights for stereo pairs, as geometry")
        stems = [Path(weights).stem for weights in self.geometry_weights]
        if len(set(stems)) < len(stems):
            raise OptionError(
                f"two weights for stereo pairs are named alike ({', '.join(stems)}): rename a file"
            )
        if not self.protocols:
            raise OptionError(f"choose a protocol: {' or '.join(PROTOCOLS)}")
        for name in self.classical:
            if name not in CLASSICAL:
                raise unknown_name("classical method", name, CLASSICAL)

    def own(self, threshold: float = 0.5) -> Method:
        """Return DeepDetect as the paper runs it: images squashed to 480x480, SIFT of size 3."""
        squashing = self.detector.configured(HeatmapOptions(480, self.channels))
        return deepdetect_method(
            squashing,
            SelectionOptions(threshold),
            name=f"deepdetect-{threshold:g}",
            title=f"DeepDetect, threshold {threshold:g}",
        )

    def controls(self) -> tuple[Method, Method]:
        """Return as many random points as DeepDetect finds, and every pixel."""
        return random_method(self.own()), every_pixel_method()

    def density_methods(self) -> tuple[Method, ...]:
        """Return the rows of Table I and of the repeatability, controls last."""
        classical = [CLASSICAL[name] for name in self.classical]
        own = [self.own(threshold) for threshold in THRESHOLDS]
        return without_repeats((*classical, *self.others, *own, *self.controls()))

    def matching_methods(self) -> tuple[Method, ...]:
        """Return the rows of Table II: the low settings, DeepDetect, controls."""
        low = [CLASSICAL[name] for name in self.classical if name in LOW]
        return without_repeats((*low, *self.others, self.own(), *self.controls()))

    def standard_methods(self) -> tuple[Method, ...]:
        """Return the rows of the standard protocol: default settings, ours sparse, controls."""
        chosen = [name for name in STANDARD if name in self.classical]
        classical = [common(STANDARD[name]) for name in chosen]
        others = [method for method in self.others if method.name not in CLASSICAL]
        named = {method.name: method for method in self.others if method.name in CLASSICAL}
        named |= {name: STANDARD[name] for name in ("sift", "orb") if name in chosen}
        systems = [
            replace(method, name=f"{method.name}-own", title=f"{method.title}, as it is")
            for method in named.values()
        ]
        own = deepdetect_method(
            self._native(),
            SelectionOptions(nms_radius=1, subpixel=True),
            name="deepdetect-sparse",
            title="DeepDetect, native resolution, suppression 3x3, sub-pixel",
            descriptor=COMMON_DESCRIPTOR,
        )
        dense = common(self.native())
        controls = (common(method) for method in self.native_controls())
        return without_repeats((*classical, *systems, *others, own, dense, *controls))

    def native(self) -> Method:
        """Return DeepDetect at the image's own size, all pixels over 0.5."""
        title = "DeepDetect, native resolution, all pixels over 0.5"
        return deepdetect_method(self._native(), name="deepdetect-native", title=title)

    def geometry_detectors(self) -> dict[str, DeepDetect]:
        """Return detectors with the weights for stereo pairs, at the image's own size, by name."""
        native = HeatmapOptions("native", self.channels)
        return {
            Path(weights).stem: self.detector.with_weights(weights).configured(native)
            for weights in self.geometry_weights
        }

    def native_controls(self) -> tuple[Method, Method]:
        """Return as many random points as `native` finds, and every pixel."""
        return random_method(self.native(), name="random-native"), every_pixel_method()

    def _native(self) -> DeepDetect:
        return self.detector.configured(HeatmapOptions("native", self.channels))


def common(method: Method) -> Method:
    """Return a method with the descriptor that all detectors get in the standard protocol.

    That knows positions only, so each is taken once: SIFT doubles some for their directions.
    """
    return replace(
        method,
        name=f"{method.name}-common",
        detect=lambda rgb: method.detect(rgb).distinct(),
        describe=COMMON_DESCRIPTOR.describe,
        binary=False,
        version=f"{method.version} {COMMON_DESCRIPTOR}",
        detection=f"{method.detection}, distinct",
    )


def without_repeats(methods: Sequence[Method]) -> tuple[Method, ...]:
    """Return the methods, each once.

    Raises:
        OptionError: two that are not the same have one name.
    """
    by_name: dict[str, Method] = {}
    for method in methods:
        if by_name.setdefault(method.name, method).version != method.version:
            raise OptionError(
                f"two methods are named {method.name}: rename one of the files they come from"
            )
    return tuple(by_name.values())
