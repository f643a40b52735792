"""Labels for training: classical detectors, and their fusion into one binary mask."""

from .detectors import DETECTOR_NAMES, DETECTORS, LabelDetector
from .fusion import Label, draw_label, fuse
from .settings import (
    LABEL_SETTINGS,
    LabelOptions,
    find_label_settings,
    read_label_settings,
)
from .visibility import LOW_VISIBILITY_RANGE, luma_range, visibility_of

__all__ = [
    "DETECTORS",
    "DETECTOR_NAMES",
    "LABEL_SETTINGS",
    "LOW_VISIBILITY_RANGE",
    "Label",
    "LabelDetector",
    "LabelOptions",
    "draw_label",
    "find_label_settings",
    "fuse",
    "luma_range",
    "read_label_settings",
    "visibility_of",
]
