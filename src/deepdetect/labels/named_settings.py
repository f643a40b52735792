"""Settings of the label detectors by name: one entry each."""

from __future__ import annotations

from pathlib import Path

from .._shared.options import is_path, look_up_word
from .settings import LabelSettings, SettingChange, read_label_settings

LABEL_SETTINGS: dict[str, LabelSettings] = {
    "paper": LabelSettings(),
    # Denser, for geometry: chosen by true stereo matches (docs/labels.md).
    "dense": LabelSettings(changes=(SettingChange("sobel", "normal", "relative_threshold", 0.02),)),
}


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
    if is_path(settings):
        return read_label_settings(settings)
    return look_up_word("label settings", settings, LABEL_SETTINGS)
