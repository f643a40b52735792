"""Settings of the label detectors: by name, from a TOML file, or changed one by one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.options import suggest_keywords
from .._shared.registry import resolve_name_or_path
from .._shared.text_files import read_toml
from .detectors import (
    DETECTOR_NAMES,
    DETECTORS,
    LabelDetector,
    run_detector,
    select_detectors,
)
from .visibility import Visibility

SECTIONS: dict[str, Visibility] = {"normal": "normal", "low_visibility": "low"}

MAX_FILE_BYTES = 16_000
"""Longer settings files are refused: all settings of all detectors take 2,000 bytes, and the time
to read some files of TOML grows with the square of their length."""


@dataclass(frozen=True)
class SettingChange:
    """A changed setting of a label detector.

    Attributes:
        detector: the detector's name, such as "fast".
        visibility: which of its two sets of settings is changed, "normal" or "low".
        name: the setting's name, such as "threshold".
        value: its new value.

    Raises:
        OptionError: a name is unknown, or the value has another type than the default or is out
            of its range.

    Example:
        >>> SettingChange("fast", "normal", "threshold", 20).value
        20
        >>> SettingChange("fast", "normal", "treshold", 20)
        Traceback (most recent call last):
        ...
        deepdetect.OptionError: unknown setting of fast 'treshold': did you mean \
'threshold'? (known: threshold, suppression)
    """

    detector: str
    visibility: Visibility
    name: str
    value: bool | int | float

    def __post_init__(self) -> None:
        if self.detector not in DETECTOR_NAMES:
            raise unknown_name("label detector", self.detector, DETECTOR_NAMES)
        if self.visibility not in SECTIONS.values():
            raise unknown_name("visibility", self.visibility, SECTIONS.values())
        default = next(entry for entry in DETECTORS if entry.name == self.detector).normal
        known = [field.name for field in dataclasses.fields(default)]
        if self.name not in known:
            raise unknown_name(f"setting of {self.detector}", self.name, known)
        if not _is_finite(self.value):
            raise OptionError(f"the setting {self.name} of {self.detector} must be finite")
        kind = type(getattr(default, self.name))
        fits = type(self.value) is kind or (kind is float and type(self.value) is int)
        if not fits:
            raise OptionError(
                f"the setting {self.name} of {self.detector} must be of type {kind.__name__}, "
                f"not {self.value!r}"
            )
        object.__setattr__(self, "value", kind(self.value))
        try:
            dataclasses.replace(default, **{self.name: self.value})
        except OptionError as error:
            raise OptionError(f"settings of {self.detector}: {error}") from None


def _is_finite(value: object) -> bool:
    """Whether a value is no number, or one that a float can hold."""
    try:
        return not isinstance(value, (int, float)) or math.isfinite(value)
    except OverflowError:
        return False


def settings_for(
    detector: LabelDetector, visibility: Visibility, changes: Iterable[SettingChange]
) -> Any:
    """Return a detector's settings for a visibility, with the changes that apply."""
    settings = detector.normal if visibility == "normal" else detector.low_visibility
    values = {
        change.name: change.value
        for change in changes
        if (change.detector, change.visibility) == (detector.name, visibility)
    }
    return dataclasses.replace(settings, **values)


@dataclass(frozen=True)
class LabelSettings:
    """The label detectors and their settings, as a settings file holds them.

    Attributes:
        detectors: names of the detectors to fuse.
        changes: changed settings.
    """

    detectors: tuple[str, ...] = DETECTOR_NAMES
    changes: tuple[SettingChange, ...] = ()

    def __post_init__(self) -> None:
        chosen = {detector.name for detector in select_detectors(self.detectors)}
        idle = sorted({change.detector for change in self.changes} - chosen)
        if idle:
            raise OptionError(
                f"settings of {idle[0]} are given, but it is not among the detectors: "
                "add it to them, or remove its settings"
            )


LABEL_SETTINGS: dict[str, LabelSettings] = {
    "paper": LabelSettings(),
    # Denser, for geometry: chosen by true stereo matches (docs/labels.md).
    "dense": LabelSettings(changes=(SettingChange("sobel", "normal", "relative_threshold", 0.02),)),
}


@suggest_keywords
def find_label_settings(settings: str | Path) -> LabelSettings:
    """Look settings up by name, or read them from a file.

    Args:
        settings: a name of `LABEL_SETTINGS`, or the path of a TOML file.

    Raises:
        OptionError: the name is unknown, or the file cannot be read or is wrong.

    Example:
        >>> find_label_settings("paper").changes
        ()
    """
    found = resolve_name_or_path("label settings", settings, LABEL_SETTINGS)
    return read_label_settings(found) if isinstance(found, Path) else found


@suggest_keywords
def read_label_settings(path: str | Path) -> LabelSettings:
    """Read detectors and their settings from a TOML file.

    The file may name the detectors, and change some of their settings::

        detectors = ["fast", "harris", "sobel"]  # default: all nine

        [fast]
        normal = { threshold = 20 }
        low_visibility = { threshold = 4 }

    Raises:
        OptionError: the file cannot be read, or a name or value is wrong.
    """
    try:
        content = read_toml(path, MAX_FILE_BYTES)
    except OSError as error:
        raise OptionError(f"{path} cannot be read ({error.strerror}): check the path") from None
    except ValueError as error:
        raise OptionError(f"{path} is no valid TOML file ({error})") from None
    try:
        return _parsed(content)
    except OptionError as error:
        raise OptionError(f"{path}: {error}") from None


def _parsed(content: dict[str, Any]) -> LabelSettings:
    detectors = content.pop("detectors", list(DETECTOR_NAMES))
    if not isinstance(detectors, list) or not all(isinstance(name, str) for name in detectors):
        raise OptionError('detectors must be a list of names, as ["fast", "sobel"]')
    changes = []
    for detector, sections in content.items():
        changes += _changes(detector, sections)
    # The order in the file has no meaning: the same settings must give equal options.
    changes.sort(key=lambda change: (change.detector, change.visibility, change.name))
    for entry in DETECTORS:
        if any(change.detector == entry.name for change in changes):
            for visibility in SECTIONS.values():
                _try(entry, visibility, changes)
    return LabelSettings(tuple(detectors), tuple(changes))


def _try(detector: LabelDetector, visibility: Visibility, changes: list[SettingChange]) -> None:
    """Run a detector once, so that values which OpenCV refuses are reported at once."""
    pattern = (np.indices((64, 64)).sum(0) // 8 % 2 * 200).astype(np.uint8)
    run_detector(detector, pattern, settings_for(detector, visibility, changes))


def _changes(detector: str, sections: Any) -> list[SettingChange]:
    if detector not in DETECTOR_NAMES:
        raise unknown_name("label detector", detector, ("detectors", *DETECTOR_NAMES))
    if not isinstance(sections, dict):
        raise OptionError(f"{detector} must be a table, as [{detector}]")
    found = []
    for section, values in sections.items():
        if section not in SECTIONS:
            raise unknown_name(f"part of {detector}", section, SECTIONS)
        if not isinstance(values, dict):
            raise OptionError(f"{section} of {detector} must be a table, as {{ threshold = 20 }}")
        found += [
            SettingChange(detector, SECTIONS[section], name, value)
            for name, value in values.items()
        ]
    return found
