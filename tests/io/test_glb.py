from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import save_point_cloud


def chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """Read the two chunks by the specification's section 4.4, checking lengths and alignment."""
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert length % 4 == 0
    tree = json.loads(data[20 : 20 + length])
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    assert kind == b"BIN\0"
    assert size % 4 == 0
    assert size == tree["buffers"][0]["byteLength"] == len(data) - 28 - length
    return tree, data[28 + length :]


def accessor(tree: dict[str, Any], data: bytes, index: int) -> np.ndarray:
    told = tree["accessors"][index]
    view = tree["bufferViews"][told["bufferView"]]
    columns = {"VEC3": 3, "VEC4": 4}[told["type"]]
    kind = {5126: "<f4", 5123: "<u2"}[told["componentType"]]
    assert view["byteOffset"] % 4 == 0
    assert view["byteOffset"] + view["byteLength"] <= len(data)
    raw = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(raw, kind).reshape(told["count"], columns)


def test_another_reader_finds_the_points_in_metres_with_y_up(
    small: PointCloud, tmp_path: Path
) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh, which reads the file back")
    save_point_cloud(small, tmp_path / "small.glb")
    scene = trimesh.load(tmp_path / "small.glb")
    (read,) = scene.dump()
    expected = small.points * [0.001, -0.001, -0.001]
    np.testing.assert_allclose(read.vertices, expected, rtol=1e-6, atol=1e-9)
    assert len(read.colors) == 256


def test_colours_are_linear_and_every_level_survives(small: PointCloud, tmp_path: Path) -> None:
    color = pytest.importorskip("skimage.color", reason="needs scikit-image's sRGB")
    save_point_cloud(small, tmp_path / "small.glb")
    tree, data = chunks(tmp_path / "small.glb")
    primitive = tree["meshes"][0]["primitives"][0]
    told = tree["accessors"][primitive["attributes"]["COLOR_0"]]
    assert told["normalized"] is True
    stored = accessor(tree, data, primitive["attributes"]["COLOR_0"])
    assert (stored[:, 3] == 65535).all()
    assert len(np.unique(stored[:, 1])) == 256  # 8 bits of linear colour have 184
    # XYZ of pure greys is linear in them: scikit-image as the other implementation.
    grey = np.repeat(small.colors[:, 1:2], 3, 1)[None]
    luminance = color.rgb2xyz(grey)[0, :, 1]
    np.testing.assert_allclose(stored[:, 1] / 65535, luminance, atol=1e-5)


def test_what_the_specification_asks_for(cones: PointCloud, tmp_path: Path) -> None:
    save_point_cloud(cones, tmp_path / "cones.glb", {"scene": "cônes"})
    tree, data = chunks(tmp_path / "cones.glb")
    primitive = tree["meshes"][0]["primitives"][0]
    assert tree["asset"]["version"] == "2.0"
    assert primitive["mode"] == 0
    told = tree["accessors"][primitive["attributes"]["POSITION"]]
    stored = accessor(tree, data, primitive["attributes"]["POSITION"])
    # Required for positions, and to be equal to what is stored, as float32.
    np.testing.assert_array_equal(np.float32(told["min"]), stored.min(0))
    np.testing.assert_array_equal(np.float32(told["max"]), stored.max(0))
    np.testing.assert_array_equal(stored, cones.points * [1, -1, -1])
    assert tree["asset"]["extras"]["notes"] == {"scene": "cônes"}
    assert "unknown length" in tree["asset"]["extras"]["unit"]


def test_the_frame_is_turned_and_not_mirrored(tmp_path: Path) -> None:
    axes = PointCloud(np.eye(3) * 1000, np.zeros((3, 3), np.uint8), "mm")
    save_point_cloud(axes, tmp_path / "axes.glb")
    turned = accessor(*chunks(tmp_path / "axes.glb"), 0)
    assert np.linalg.det(turned) == pytest.approx(1)
    np.testing.assert_array_equal(turned[1], [0, -1, 0])  # down is down
