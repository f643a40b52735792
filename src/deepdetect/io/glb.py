"""Binary glTF 2.0 (GLB), which browsers, Blender, Windows and game engines read.

Source: Khronos Group, glTF 2.0 specification, sections 3.4 (y up, z towards the viewer,
metres), 3.6.2.4 (alignment), 3.7.2.1 (points, COLOR_0) and 4.4 (GLB). trimesh's writer is not
used because it stores linear colour in 8 bits, which causes banding in shadows.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.image_array import srgb_to_linear
from ..geometry.point_cloud import EAST_NORTH_UP, UNITS, PointCloud

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT, POINTS, TRIANGLES = 5126, 5123, 5125, 0, 4
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


def write_glb(
    cloud: PointCloud, path: Path, metadata: Mapping[str, str], faces: np.ndarray | None = None
) -> None:
    """Write the points in glTF's frame with their colours, 20 bytes per point.

    Colours are converted to linear values, as glTF requires. They have 16 bits, so that all 256
    sRGB levels stay distinct. The asset's extras contain the metadata, the unit and the frame. If
    `faces`, (M, 3) indices of points, are given, the points become a triangle mesh.
    """
    # A rotation about the x axis makes y point up: by 180 degrees for a camera's frame, and by 90
    # for a frame with z up. Units of unknown length are written as metres, and the extras say so.
    turned = cloud.points[:, [0, 2, 1]] if cloud.frame == EAST_NORTH_UP else cloud.points
    signs = [1, 1, -1] if cloud.frame == EAST_NORTH_UP else [1, -1, -1]
    unit = 1e-3 if cloud.unit == "mm" else 1.0
    positions = (turned * (np.array(signs) * unit)).astype("<f4")
    colors = np.full((len(cloud), 4), 65535, "<u2")
    colors[:, :3] = np.rint(65535 * srgb_to_linear()).astype("<u2")[cloud.colors]
    corners = np.ascontiguousarray(np.empty(0) if faces is None else faces, "<u4")
    tree = _tree(cloud, positions, metadata, corners.size)
    text = json.dumps(tree, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    size = positions.nbytes + colors.nbytes + corners.nbytes  # a multiple of 4
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + size, len(text), b"JSON")
    with path.open("wb") as file:
        file.write(head + text + struct.pack("<I4s", size, b"BIN\0"))
        for values in (positions, colors, corners):
            values.tofile(file)


def _tree(
    cloud: PointCloud, positions: np.ndarray, metadata: Mapping[str, str], corners: int
) -> dict[str, Any]:
    count = len(cloud)
    box = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": POINTS, "material": 0}
    primitive |= {"mode": TRIANGLES, "indices": 2} if corners else {}
    unit = "metres" if cloud.unit in ("mm", "m") else f"{UNITS[cloud.unit]}, of unknown length"
    rough = {"metallicFactor": 0, "roughnessFactor": 1}
    frame = "x east, y up, z south"
    if cloud.frame != EAST_NORTH_UP:
        frame = f"origin at the {cloud.frame}, x right, y up, z backward"
    extras = {"unit": unit, "frame": frame, "notes": dict(metadata)}
    return {
        "asset": {"version": "2.0", "generator": "deepdetect", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "point cloud"}],
        "meshes": [{"primitives": [primitive]}],
        # Without normals points cannot be lit. This extension tells viewers to show plain colours.
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [
            {"pbrMetallicRoughness": rough, "extensions": {"KHR_materials_unlit": {}}}
            | {"doubleSided": True}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": FLOAT, "type": "VEC3", "count": count, **box},
            {"bufferView": 1, "componentType": UNSIGNED_SHORT, "type": "VEC4", "count": count}
            | {"normalized": True},
            {"bufferView": 2, "componentType": UNSIGNED_INT, "type": "SCALAR", "count": corners},
        ][: 3 if corners else 2],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": length, "target": target}
            for offset, length, target in (
                (0, 12 * count, ARRAY_BUFFER),
                (12 * count, 8 * count, ARRAY_BUFFER),
                (20 * count, 4 * corners, ELEMENT_ARRAY_BUFFER),
            )[: 3 if corners else 2]
        ],
        "buffers": [{"byteLength": 20 * count + 4 * corners}],
    }
