"""Methods: the detectors with their descriptors that the benchmarks compare."""

from .heatmaps import (
    COMMON_DESCRIPTOR,
    PointDescriptor,
    deepdetect_method,
    every_pixel_method,
    random_method,
)
from .importable import importable_method
from .method import Method
from .onnx_file import onnx_method
from .registry import CLASSICAL, STANDARD, find_method

__all__ = [
    "CLASSICAL",
    "COMMON_DESCRIPTOR",
    "STANDARD",
    "Method",
    "PointDescriptor",
    "deepdetect_method",
    "every_pixel_method",
    "find_method",
    "importable_method",
    "onnx_method",
    "random_method",
]
