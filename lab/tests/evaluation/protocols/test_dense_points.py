"""Clouds of other programs beside the dense points of a model."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from tests.command_line import run_command

from deepdetect import Camera, DeepDetectError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.io.point_cloud import save_point_cloud
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect_lab.evaluation.protocols.dense_points import compare_clouds

SIZE, FOCAL_PX, DEPTH = (320, 240), 250.0, 4.0


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """Two cameras that see the same, 1,000 pixels apart in what they look at."""
    made = pycolmap.Reconstruction()
    camera = CameraIntrinsics.of_camera(Camera(SIZE, FOCAL_PX)).colmap_camera()
    camera.camera_id = 1
    made.add_camera_with_trivial_rig(camera)
    for number in (1, 2):
        image = pycolmap.Image(
            name=f"{number}.jpg", keypoints=np.empty((0, 2)), camera_id=1, image_id=number
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [(1 - number) * 16.0, 0, 0])
        made.add_image_with_trivial_frame(image, pose)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    made.write(tmp_path / "sparse" / "0")
    return tmp_path


def wall(depth: float, columns: int) -> np.ndarray:
    """A plane before the first camera, a point at every second pixel of the first columns."""
    x, y = np.meshgrid(np.arange(0, columns, 2), np.arange(0, SIZE[1], 2))
    centre = (np.array(SIZE) - 1) / 2
    xy = (np.column_stack([x.ravel(), y.ravel()]) - centre) / FOCAL_PX
    return np.column_stack([xy, np.ones(len(xy))]) * depth


def save(points: np.ndarray, path: Path) -> None:
    save_point_cloud(PointCloud(points, np.zeros(points.shape, np.uint8), "spacing"), path)


def write_openmvs(path: Path, points: np.ndarray) -> None:
    """Write points as OpenMVS does: with the images that see each one."""
    names = [f"property float32 {axis}" for axis in "xyz"]
    names += [f"property uint8 {color}" for color in ("red", "green", "blue")]
    names += ["property list uint8 uint32 view_indices", "property list uint8 float32 view_weights"]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *names]
    with path.open("wb") as file:
        file.write("\n".join([*head, "end_header\n"]).encode())
        for number, point in enumerate(points):
            seen = 2 + number % 3
            file.write(struct.pack("<fffBBBB", *point, 9, 9, 9, seen))
            file.write(struct.pack(f"<{seen}IB{seen}f", *range(seen), seen, *range(seen)))


def test_shares_and_depths_are_those_of_made_walls(model: Path) -> None:
    save(points := wall(DEPTH, 320), model / "model.ply")
    # The left half is 2 % farther in its upper three quarters.
    half = wall(DEPTH, 160)
    half[half[:, 1] < DEPTH * 60 / FOCAL_PX] *= 1.02
    write_openmvs(model / "other.ply", half)
    first, other = compare_clouds(model, [model / "model.ply", model / "other.ply"])
    assert (first["points"], other["points"]) == (len(points), len(half))
    # Two images: the second sees none of it.
    assert first["share"] == pytest.approx(0.5, abs=0.01)
    assert other["share"] == pytest.approx(0.25, abs=0.01)
    assert first.keys() == {"cloud", "points", "share"}
    assert other["from the first: median difference"] == pytest.approx(0.02, abs=1e-4)
    assert other["from the first: share apart"] == pytest.approx(0.75, abs=0.01)


def test_of_two_points_in_a_cell_the_nearer_counts(model: Path) -> None:
    save(wall(DEPTH, 320), model / "model.ply")
    both = np.concatenate([wall(DEPTH, 320), wall(2 * DEPTH, 320)])
    save(both, model / "both.ply")
    row = compare_clouds(model, [model / "model.ply", model / "both.ply"])[1]
    assert row["from the first: median difference"] == 0


def test_the_command(model: Path) -> None:
    save(wall(DEPTH, 320), model / "model.ply")
    result = run_command(["dev", "compare-clouds", str(model), str(model / "model.ply"), "--json"])
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)
    assert [row["points"] for row in rows] == [160 * 120] * 2
    assert rows[1]["from the first: share apart"] == 0
    shown = run_command(["dev", "compare-clouds", str(model), str(model / "model.ply")])
    assert "| 19,200 | 0.5" in shown.stdout


@pytest.mark.parametrize("count", [None, b"1", b"2"])
def test_what_is_no_cloud(model: Path, count: bytes | None) -> None:
    path = model / "cloud.ply"
    if count is not None:
        head = b"ply\nformat ascii 1.0\nelement vertex " + count
        path.write_bytes(head + b"\nproperty float x\nend_header\n1\n")
    with pytest.raises(DeepDetectError, match="cloud"):
        compare_clouds(model, [path])


@pytest.mark.parametrize("text_format", ["ascii", "binary_big_endian"])
def test_clouds_of_other_kinds(model: Path, text_format: str) -> None:
    points = wall(DEPTH, 320)
    save(points, model / "model.ply")
    points = np.append(points, [(np.nan, 0, 1)], axis=0)
    head = f"ply\nformat {text_format} 1.0\ncomment TextureFile möbel.png\n"
    head += f"element vertex {len(points)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    body = points.astype(">f8").tobytes()
    if text_format == "ascii":
        body = "\n".join(" ".join(map(str, point)) for point in points.tolist()).encode() + b"\n"
    (model / "other.ply").write_bytes(head.encode() + body)
    row = compare_clouds(model, [model / "model.ply", model / "other.ply"])[1]
    assert row["points"] == len(points) - 1
    assert row["from the first: median difference"] == pytest.approx(0, abs=1e-6)


def test_models_of_other_kinds(model: Path) -> None:
    save(wall(DEPTH, 320), model / "model.ply")
    sparse = model / "sparse" / "0"
    made = pycolmap.Reconstruction(sparse)
    (sparse / "images.bin").write_bytes((sparse / "images.bin").read_bytes()[:30])
    with pytest.raises(DeepDetectError):
        compare_clouds(model, [])
    for file in sparse.iterdir():
        file.unlink()
    made.write_text(sparse)
    assert compare_clouds(model, [model / "model.ply"])[0]["share"] > 0.4
    with pytest.raises(DeepDetectError):
        compare_clouds(model / "gone", [])
