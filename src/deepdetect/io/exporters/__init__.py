"""Files of point clouds and depth maps."""

from ..depth import DepthPng, load_depth_png, save_depth_npz, save_depth_png
from ..exporters_registry import EXPORTERS, get_exporter, save_point_cloud

__all__ = [
    "EXPORTERS",
    "DepthPng",
    "get_exporter",
    "load_depth_png",
    "save_depth_npz",
    "save_depth_png",
    "save_point_cloud",
]
