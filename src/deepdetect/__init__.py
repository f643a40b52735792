"""DeepDetect: dense keypoints from a tiny network, their matches, and models in space.

    >>> from deepdetect import DeepDetect, match_images
    >>> detector = DeepDetect()

The road of the data: image -> heatmap -> keypoints -> descriptors -> matchers -> geometry ->
reconstruction.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .detector import DeepDetect
    from .errors import (
        DeepDetectError,
        ImageError,
        MissingExtraError,
        OptionError,
        ReconstructionError,
        WeightsError,
    )
    from .exporters import save_point_cloud
    from .geometry import Geometry, GeometryOptions, estimate_geometry
    from .heatmap import HeatmapOptions
    from .image import load_image
    from .keypoints import Keypoints, SelectionOptions, select_keypoints
    from .labels import Label, LabelOptions, fuse
    from .matching import Matches, match_images
    from .point_cloud import PointCloud
    from .presets import MatchingOptions
    from .reconstruction.calibration import Calibration, Camera
    from .reconstruction.reconstruct import ReconstructionOptions, reconstruct
    from .reconstruction.result import Reconstruction

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "reconstruction.calibration",
    "Camera": "reconstruction.calibration",
    "DeepDetect": "detector",
    "DeepDetectError": "errors",
    "Geometry": "geometry",
    "GeometryOptions": "geometry",
    "HeatmapOptions": "heatmap",
    "ImageError": "errors",
    "Keypoints": "keypoints",
    "Label": "labels",
    "LabelOptions": "labels",
    "Matches": "matching",
    "MatchingOptions": "presets",
    "MissingExtraError": "errors",
    "OptionError": "errors",
    "PointCloud": "point_cloud",
    "Reconstruction": "reconstruction.result",
    "ReconstructionError": "errors",
    "ReconstructionOptions": "reconstruction.reconstruct",
    "SelectionOptions": "keypoints",
    "WeightsError": "errors",
    "estimate_geometry": "geometry",
    "fuse": "labels",
    "load_image": "image",
    "match_images": "matching",
    "reconstruct": "reconstruction.reconstruct",
    "save_point_cloud": "exporters",
    "select_keypoints": "keypoints",
}

__all__ = [
    "Calibration",
    "Camera",
    "DeepDetect",
    "DeepDetectError",
    "Geometry",
    "GeometryOptions",
    "HeatmapOptions",
    "ImageError",
    "Keypoints",
    "Label",
    "LabelOptions",
    "Matches",
    "MatchingOptions",
    "MissingExtraError",
    "OptionError",
    "PointCloud",
    "Reconstruction",
    "ReconstructionError",
    "ReconstructionOptions",
    "SelectionOptions",
    "WeightsError",
    "__version__",
    "estimate_geometry",
    "fuse",
    "load_image",
    "match_images",
    "reconstruct",
    "save_point_cloud",
    "select_keypoints",
]


def __getattr__(name: str) -> Any:
    # Loaded when first used, so that the command line starts fast.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
