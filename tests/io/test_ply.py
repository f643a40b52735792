from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import save_point_cloud

trimesh = pytest.importorskip("trimesh", reason="needs trimesh, which reads the files back")


def test_another_reader_finds_the_same_points_and_colours(
    cones: PointCloud, tmp_path: Path
) -> None:
    save_point_cloud(cones, tmp_path / "cones.ply")
    read = trimesh.load(tmp_path / "cones.ply")
    np.testing.assert_array_equal(read.vertices.astype(np.float32), cones.points)
    np.testing.assert_array_equal(read.colors[:, :3], cones.colors)


def header(path: Path) -> list[str]:
    return path.read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()


def test_the_header_tells_unit_frame_and_notes(small: PointCloud, tmp_path: Path) -> None:
    path = tmp_path / "small.ply"
    save_point_cloud(small, path, {"scène\nfoo": "line\nelement vertex 7", "share": 0.95312})
    lines = header(path)
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("element")] == ["element vertex 256"]
    assert "comment unit: millimetres" in lines
    assert any("x right, y down, z forward" in line for line in lines)
    assert "comment sc?ne foo: line element vertex 7" in lines
    assert "comment share: 0.9531" in lines
    assert len(trimesh.load(path).vertices) == 256
