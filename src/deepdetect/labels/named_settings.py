"""Settings of the label detectors by name: one entry each."""

from __future__ import annotations

from pathlib import Path

from ..errors import look_up
from .settings import LabelSettings, SettingChange, read_label_settings

LABEL_SETTINGS: dict[str, LabelSettings] = {
    "paper": LabelSettings(),
    # Denser, for geometry: most true stereo matches of the settings tried (docs/labels.md).
    "geometry": LabelSettings(
        changes=(SettingChange("sobel", "normal", "relative_threshold", 0.02),)
    ),
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
    path = Path(settings)
    if path.suffix or len(path.parts) > 1:
        return read_label_settings(path)
    return look_up("label settings", path.name, LABEL_SETTINGS)
