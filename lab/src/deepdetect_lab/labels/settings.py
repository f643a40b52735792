"""Choose the detectors of labels and their settings: by name, in a TOML file, or one by one."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from deepdetect._shared.errors import OptionError, check_name, unknown_name
from deepdetect._shared.options import look_up, names_a_file, suggest_keywords

from .detectors import DETECTOR_NAMES, DETECTORS, Value, select_detectors

Visibility = Literal["normal", "low"]

Settings = Mapping[str, Mapping[str, Mapping[str, Value]]]
"""Settings that differ from the defaults: their values by detector, then by section ("normal" or
"low_visibility"), then by name of the setting."""

SECTIONS: dict[Visibility, str] = {"normal": "normal", "low": "low_visibility"}


@suggest_keywords
@dataclass(frozen=True)
class LabelOptions:
    """The detectors that make a label, and their settings.

    Attributes:
        detectors: names of the detectors to fuse (default: all nine).
        visibility: which settings to use: those for "normal" or for "low" visibility. With "auto",
            `visibility_of` chooses them for each image.
        settings: settings that differ from the paper's, by detector and then by section, which is
            "normal" or "low_visibility".

    Raises:
        OptionError: a name is unknown, or a value has the wrong type or is out of its range.

    Example:
        >>> LabelOptions(settings={"fast": {"normal": {"threshold": 20}}}).visibility
        'auto'
        >>> LabelOptions(settings={"fast": {"normal": {"treshold": 20}}})
        Traceback (most recent call last):
        ...
        deepdetect.OptionError: unknown setting of fast 'treshold': did you mean \
'threshold'? (known: threshold, suppression)
    """

    detectors: tuple[str, ...] = DETECTOR_NAMES
    visibility: Literal["auto", "normal", "low"] = "auto"
    settings: Settings = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        names = (self.detectors,) if isinstance(self.detectors, str) else self.detectors
        object.__setattr__(self, "detectors", select_detectors(names))
        check_name("visibility", self.visibility, ("auto", *SECTIONS))
        checked = {name: _checked(name, self.settings[name]) for name in self.settings}
        object.__setattr__(self, "settings", checked)
        if idle := sorted(checked.keys() - set(self.detectors)):
            raise OptionError(
                f"{idle[0]} has settings but is not among the detectors: add it to them, or remove "
                "its settings"
            )

    def with_detectors(self, names: tuple[str, ...]) -> LabelOptions:
        """Return options with other detectors. Settings of detectors not in `names` are dropped."""
        kept = {name: self.settings[name] for name in self.settings if name in names}
        return replace(self, detectors=names, settings=kept)

    def parameters(self, detector: str, visibility: Visibility) -> dict[str, Value]:
        """Return the values of all settings of a detector for images of the given visibility."""
        entry = DETECTORS[detector]
        low = entry.low_visibility if visibility == "low" else {}
        changed = self.settings.get(detector, {}).get(SECTIONS[visibility], {})
        return {**entry.defaults, **low, **changed}


def _checked(detector: str, sections: Any) -> dict[str, dict[str, Value]]:
    if detector not in DETECTORS:
        raise unknown_name("label detector", detector, ("detectors", *DETECTOR_NAMES))
    if not isinstance(sections, Mapping) or not all(
        isinstance(values, Mapping) for values in sections.values()
    ):
        raise OptionError(
            f"{detector} must be a table of tables, like normal = {{ threshold = 20 }}"
        )
    for section in sections:
        check_name(f"part of {detector}", section, SECTIONS.values())
    return {
        section: {name: _checked_value(detector, name, value) for name, value in values.items()}
        for section, values in sections.items()
    }


def _checked_value(detector: str, name: str, value: Any) -> Value:
    settings = DETECTORS[detector].settings
    check_name(f"setting of {detector}", name, settings)
    default, limits = settings[name]
    kind = type(default)
    if type(value) is not kind and not (kind is float and type(value) is int):
        raise OptionError(f"{name} of {detector} must be of type {kind.__name__}, not {value!r}")
    if limits is None:
        return bool(value)
    if not limits[0] <= value <= limits[-1]:  # also excludes NaN
        raise OptionError(f"{name} of {detector} must lie in [{limits[0]:.12g}, {limits[-1]:.12g}]")
    if isinstance(limits, range) and value not in limits:
        raise OptionError(f"the setting {name} of {detector} must be odd, not {value}")
    return kind(value)


LABEL_SETTINGS: dict[str, LabelOptions] = {
    "paper": LabelOptions(),
    # On Middlebury's cones and teddy, these labels give 84,425 and 73,313 correct matches, the
    # paper's 46,726 and 35,224, mostly due to their density (docs/results/labels-stereo.csv).
    "dense": LabelOptions(settings={"sobel": {"normal": {"relative_threshold": 0.02}}}),
}


def find_label_settings(settings: str | Path) -> LabelOptions:
    """Look up label settings by name, or read them from a file.

    A TOML file may choose detectors and change some of their settings::

        detectors = ["fast", "harris", "sobel"]  # default: all nine

        [fast]
        normal = { threshold = 20 }
        low_visibility = { threshold = 4 }

    Args:
        settings: a name of `LABEL_SETTINGS`, or the path of a file.

    Raises:
        OptionError: the name is unknown, or the file cannot be read or has a wrong entry.

    Example:
        >>> find_label_settings("dense").settings
        {'sobel': {'normal': {'relative_threshold': 0.02}}}
    """
    if not names_a_file(settings):
        return look_up("name or file of label settings", str(settings), LABEL_SETTINGS)
    path = Path(settings)
    try:
        content = tomllib.loads(path.read_text("utf-8-sig"))
    except OSError as error:
        raise OptionError(f"{path} cannot be read ({error.strerror}): check the path") from None
    except (ValueError, RecursionError) as error:
        raise OptionError(f"{path} is not a valid TOML file ({error})") from None
    detectors = content.pop("detectors", list(DETECTOR_NAMES))
    try:
        if not isinstance(detectors, list) or not all(isinstance(name, str) for name in detectors):
            raise OptionError('detectors must be a list of names, for example ["fast", "sobel"]')
        return LabelOptions(tuple(detectors), settings=content)
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None
