"""Binary PLY, which MeshLab, CloudCompare, Blender, Open3D and COLMAP read.

Source: G. Turk, The PLY polygon file format, 1994. Our own writer, since those of libraries
write no comments, which hold the unit and the frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..geometry.point_cloud import PointCloud

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])

UNIT_NAMES = {
    "mm": "millimetres",
    "baseline": "baselines (1 = the distance of the two cameras)",
    "spacing": "spacings (1 = the median distance from a camera to the nearest other one)",
}


def write_ply(cloud: PointCloud, path: Path, metadata: Mapping[str, str]) -> None:
    """Write float x y z and uchar red green blue, little-endian, 15 bytes per point.

    Frame, unit and metadata are comments, in which what is not ASCII becomes "?".
    """
    vertices = np.empty(len(cloud), VERTEX)
    vertices["xyz"] = cloud.points
    vertices["rgb"] = cloud.colors
    with path.open("wb") as file:
        file.write(_header(cloud, metadata).encode("ascii", "replace"))
        vertices.tofile(file)


def _header(cloud: PointCloud, metadata: Mapping[str, str]) -> str:
    comments = [
        "written by deepdetect",
        f"unit: {UNIT_NAMES[cloud.unit]}",
        f"frame: {cloud.frame}, x right, y down, z forward, origin at its centre",
        *(f"{name}: {text}" for name, text in metadata.items()),
    ]
    return "\n".join(
        [
            "ply",
            "format binary_little_endian 1.0",
            *(f"comment {comment}" for comment in comments),
            f"element vertex {len(cloud)}",
            *(f"property float {axis}" for axis in "xyz"),
            *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
            "end_header\n",
        ]
    )
