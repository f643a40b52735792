"""Make labels for training: fuse the detections of classical detectors into one binary mask."""

from .detectors import DETECTOR_NAMES, DETECTORS, LabelDetector
from .fusion import Label, draw_label, fuse, visibility_of
from .settings import LABEL_SETTINGS, LabelOptions, find_label_settings

__all__ = [
    "DETECTORS",
    "DETECTOR_NAMES",
    "LABEL_SETTINGS",
    "Label",
    "LabelDetector",
    "LabelOptions",
    "draw_label",
    "find_label_settings",
    "fuse",
    "visibility_of",
]
