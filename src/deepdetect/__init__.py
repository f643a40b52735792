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
    from ._shared.errors import (
        DeepDetectError,
        ImageError,
        MissingExtraError,
        OptionError,
        ReconstructionError,
        WeightsError,
    )
    from .detector.detector import DeepDetect
    from .detector.heatmap import HeatmapOptions
    from .features.keypoints import Keypoints, SelectionOptions, select_keypoints
    from .geometry import Geometry, GeometryOptions, estimate_geometry
    from .geometry.camera import Calibration, Camera
    from .geometry.point_cloud import PointCloud
    from .io.exporters import save_point_cloud
    from .io.image import load_image
    from .labels import Label, LabelOptions, fuse
    from .matching.options import MatchingOptions
    from .matching.pipeline import Matches, match_images
    from .reconstruction.pipeline import ReconstructionOptions, reconstruct
    from .reconstruction.result import Reconstruction

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "geometry.camera",
    "Camera": "geometry.camera",
    "DeepDetect": "detector.detector",
    "DeepDetectError": "_shared.errors",
    "Geometry": "geometry",
    "GeometryOptions": "geometry",
    "HeatmapOptions": "detector.heatmap",
    "ImageError": "_shared.errors",
    "Keypoints": "features.keypoints",
    "Label": "labels",
    "LabelOptions": "labels",
    "Matches": "matching.pipeline",
    "MatchingOptions": "matching.options",
    "MissingExtraError": "_shared.errors",
    "OptionError": "_shared.errors",
    "PointCloud": "geometry.point_cloud",
    "Reconstruction": "reconstruction.result",
    "ReconstructionError": "_shared.errors",
    "ReconstructionOptions": "reconstruction.pipeline",
    "SelectionOptions": "features.keypoints",
    "WeightsError": "_shared.errors",
    "estimate_geometry": "geometry",
    "fuse": "labels",
    "load_image": "io.image",
    "match_images": "matching.pipeline",
    "reconstruct": "reconstruction.pipeline",
    "save_point_cloud": "io.exporters",
    "select_keypoints": "features.keypoints",
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
