"""Photographs of the fountain with fixes at their known places, and all that is written of them."""

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base

from deepdetect import (
    Camera,
    MissingExtraError,
    OptionError,
    PointDetector,
    ReconstructionError,
    reconstruct_many,
)
from deepdetect.geometry.camera import PosedView
from deepdetect.geometry.point_cloud import EAST_NORTH_UP, PointCloud
from deepdetect.sfm import MultiViewOptions, MultiViewReconstruction
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.formats import FORMATS, write_mesh
from deepdetect.sfm.georeference import Georeference
from deepdetect.sfm.splat import seen_depths, thinned, write_transforms
from deepdetect_lab.datasets.posed_images import load_posed_scenes

from ..io.test_gps import place_tags

NAMES, TURNED = ("0003", "0004", "0005", "0006"), "0006"
METRES_PER_DEGREE = np.array([111_132.95, 78_846.8])
"""A degree of latitude and one of longitude have these lengths at 45 degrees north (WGS 84)."""


@pytest.fixture(scope="module")
def centres(shared: Path) -> np.ndarray:
    """Where the cameras are, in metres."""
    (scene,) = load_posed_scenes(shared / "data" / "fountain")
    poses = {image.path.stem: image for image in scene.images}
    return np.array([-poses[name].rotation.T @ poses[name].translation for name in NAMES])


@pytest.fixture(scope="module")
def placed(
    write_fountain, centres: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, MultiViewReconstruction]:
    """The folder of a model in all formats, and the model."""
    for package in ("h5py", "pycolmap", "laspy", "lazrs", "pyproj", "rasterio"):
        pytest.importorskip(package, reason=f"needs {package}")
    root = tmp_path_factory.mktemp("placed")
    folder = write_fountain(root / "photos", NAMES, 288)
    for name, (east, north, up) in zip(NAMES, centres, strict=True):
        path = folder / f"{name}.jpg"
        with Image.open(path) as image:
            exif = image.getexif()
            latitude, longitude = [45, 9] + np.array([north, east]) / METRES_PER_DEGREE
            exif.get_ifd(IFD.GPSInfo).update(place_tags(latitude, longitude, up + 100))
            exif.get_ifd(IFD.GPSInfo)[GPS.GPSHPositioningError] = 0.02
            if name == TURNED:
                exif[Base.Orientation] = 3  # it is stored upside down
                image = image.transpose(Image.Transpose.ROTATE_180)
            image.save(path, quality=95, exif=exif)
    options = MultiViewOptions(stride_px=4, formats=tuple(FORMATS))
    detector = PointDetector(1000)
    return root / "model", reconstruct_many(
        folder, root / "model", detector, options=options, workers=1
    )


def test_the_model_is_in_metres_at_its_place(placed, centres: np.ndarray) -> None:
    output, found = placed
    assert isinstance(found.georeference, Georeference)
    assert set(found.views) == {f"{name}.jpg" for name in NAMES}
    distances = np.linalg.norm(np.diff(found.centres, axis=0), axis=1)
    np.testing.assert_allclose(
        distances, np.linalg.norm(np.diff(centres, axis=0), axis=1), rtol=0.03
    )
    direction, true = (points[-1] - points[0] for points in (found.centres, centres))
    assert direction / np.linalg.norm(direction) @ true > 0.999 * np.linalg.norm(true)
    values = json.loads((output / "model.json").read_text())
    assert values["georeference"]["origin"]["latitude"] == pytest.approx(45, abs=1e-3)
    assert set(values["georeference"]["residuals_m"]) == set(found.views)
    assert values["cameras"]["0004.jpg"]["centre"] == found.views["0004.jpg"].centre.tolist()
    assert found.cloud.unit == "m"
    assert b"frame: x east, y north, z up" in (output / "model.ply").read_bytes()[:600]
    assert {path.name for path in output.iterdir()} == {
        *(path.name for path in found.files),
        "work",
    }


def test_dense_points_lie_where_the_sparse_ones_do(placed) -> None:
    _, found = placed
    for view in found.views.values():
        xy, depth = view.project(found.dense.points)
        _, own = view.project(found.sparse.points)
        assert np.median(depth) == pytest.approx(np.median(own), rel=0.3)
        assert ((xy > 0) & (xy < view.camera.size)).all(axis=1).mean() > 0.5


def test_laz_is_read_by_laspy(placed) -> None:
    import laspy

    output, found = placed
    las = laspy.read(output / "model.laz")
    assert las.header.parse_crs().to_epsg() == 32632
    assert found.georeference.origin is not None
    utm, _ = found.georeference.origin.to_utm(found.dense.points)
    np.testing.assert_allclose(las.xyz, utm, atol=1e-3)
    np.testing.assert_array_equal(np.asarray(las.blue) // 257, found.dense.colors[:, 2])


def test_maps_are_read_by_rasterio(placed) -> None:
    import rasterio

    output, found = placed
    utm, _ = found.georeference.origin.to_utm(found.dense.points)
    with (
        rasterio.open(output / "height.tif") as heights,
        rasterio.open(output / "orthophoto.tif") as photo,
    ):
        assert heights.crs.to_epsg() == photo.crs.to_epsg() == 32632
        assert heights.transform == photo.transform
        assert heights.transform.e == -heights.transform.a  # north is up
        sampled = np.array([value[0] for value in heights.sample(utm[:, :2])])
        colors = np.array([*photo.sample(utm[:, :2])])
    # Of the few points outside the map there is no height; the others are near their own.
    known = np.isfinite(sampled)
    assert known.mean() > 0.9
    assert np.median(np.abs(sampled - utm[:, 2])[known]) < np.ptp(utm[known, 2]) / 4
    assert (colors[known].sum(axis=1) > 0).mean() > 0.99


@pytest.mark.parametrize("name", ["transforms.json", "splat/transforms.json"])
def test_transforms_are_as_nerfstudio_reads_them(placed, name: str) -> None:
    """Its own parser needs gigabytes; this is what it does: OpenGL's cameras, COLMAP's pixels."""
    output, found = placed
    path = output / name
    values = json.loads(path.read_text())
    assert values["camera_model"] == "OPENCV"
    with (path.parent / values["ply_file_path"]).open("rb") as file:
        assert file.read(3) == b"ply"
    assert len(values["frames"]) == len(found.views)
    for frame in values["frames"]:
        with Image.open(path.parent / frame["file_path"]) as image:
            assert image.size == (frame["w"], frame["h"])
            rgb = np.asarray(image).astype(int)
            if image.getexif().get(Base.Orientation) == 3:  # nerfstudio does not turn it: docs
                rgb = rgb[::-1, ::-1]
        camera = np.linalg.inv(frame["transform_matrix"])
        x, y, z = camera[:3, :3] @ found.dense.points.T + camera[:3, 3:]
        across, down = x / -z, -y / -z
        bent = 1 + frame["k1"] * (across**2 + down**2)
        column = frame["fl_x"] * across * bent + frame["cx"]
        row = frame["fl_y"] * down * bent + frame["cy"]
        inside = (z < 0) & (column > 1) & (row > 1)
        inside &= (column < frame["w"] - 1) & (row < frame["h"] - 1)
        assert inside.mean() > 0.5
        shown = rgb[row[inside].astype(int), column[inside].astype(int)]
        differences = np.abs(shown - found.dense.colors[inside]).mean(axis=1)
        shifted = rgb[row[inside].astype(int) - 1, column[inside].astype(int) - 1]
        assert np.median(differences) < 15
        assert differences.mean() < np.abs(shifted - found.dense.colors[inside]).mean()


def test_the_splats_model_is_read_by_pycolmap(placed, pycolmap) -> None:
    output, found = placed
    model = pycolmap.Reconstruction(output / "splat" / "sparse" / "0")
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == len(found.sparse) + len(found.dense)
    before = pycolmap.Reconstruction(output / "sparse" / "0")
    assert len(before.points3D) == len(found.sparse)
    errors = []
    for each in (model, before):
        distances = []
        for point in each.points3D.values():
            for element in point.track.elements:
                image = each.images[element.image_id]
                seen = image.points2D[element.point2D_idx].xy
                distances.append(np.linalg.norm(image.project_point(point.xyz) - seen))
        errors.append(np.mean(distances))
    assert errors[0] == pytest.approx(errors[1], rel=0.02)
    for image in model.images.values():
        with Image.open(output / "splat" / "images" / image.name) as picture:
            assert picture.size == (image.camera.width, image.camera.height)
            assert np.asarray(picture)[[0, -1]].max() > 0
    dense = [point for point in model.points3D.values() if not point.track.elements]
    colors = {tuple(point.color) for point in dense}
    assert colors == set(map(tuple, found.dense.colors.tolist()))
    assert {round(float(p.error), 5) for p in dense} == {
        round(float(error), 5) for error in found.dense_errors
    }


def test_normals_are_those_of_the_surface_and_meshed(placed) -> None:
    """They look at a camera that sees the point, and the mesh is where the points are."""
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh")
    output, found = placed
    cloud = found.dense
    assert cloud.normals is not None
    towards = [
        ((view.centre - cloud.points) * cloud.normals).sum(1) for view in found.views.values()
    ]
    assert (np.max(towards, axis=0) > 0).mean() > 0.95
    header = (output / "model.ply").read_bytes().partition(b"end_header")[0]
    assert b"property float nx\nproperty float ny\nproperty float nz" in header
    mesh = trimesh.load(output / "mesh.ply", process=False)
    low, high = np.percentile(cloud.points, (5, 95), axis=0)
    assert ((mesh.vertices > low - 1) & (mesh.vertices < high + 1)).all(axis=1).mean() > 0.8
    assert 0.2 < len(mesh.vertices) / len(cloud) < 5


def test_text_is_the_same_model(placed, pycolmap) -> None:
    output, _ = placed
    text, binary = (pycolmap.Reconstruction(output / n) for n in ("sparse_text", "sparse/0"))
    assert text.num_points3D() == binary.num_points3D()
    point = next(iter(binary.points3D))
    np.testing.assert_allclose(text.points3D[point].xyz, binary.points3D[point].xyz)
    np.testing.assert_array_equal(text.points3D[point].color, binary.points3D[point].color)
    assert binary.points3D[point].color.max() > 0


def test_depth_maps_are_depths(placed) -> None:
    output, found = placed
    values = json.loads((output / "splat" / "transforms.json").read_text())
    for frame, view in zip(values["frames"], found.views.values(), strict=True):
        with Image.open(output / "splat" / frame["depth_file_path"]) as image:
            assert image.size == (frame["w"], frame["h"])
            depths = np.asarray(image) * values["depth_unit_scale_factor"]
        assert image.mode == "I;16"
        _, depth = view.project(found.dense.points)
        assert np.median(depths[depths > 0]) == pytest.approx(np.median(depth[depth > 0]), rel=0.2)
        assert (depths > 0).mean() > 0.1


def test_what_is_seen_through_gaps_is_left_out() -> None:
    """A near plane with a point at every second pixel hides a far one."""
    camera = Camera((40, 40), 40.0)
    y, x = np.mgrid[0:40:2, 0:40:2].reshape(2, -1)
    near = camera.rays(np.column_stack([x, y]).astype(float)) * 2.0
    y, x = np.mgrid[0:40, 0:40].reshape(2, -1)
    far = camera.rays(np.column_stack([x, y]).astype(float)) * 8.0
    view = SimpleNamespace(
        camera=camera, project=lambda points: (camera.project(points), points[:, 2])
    )
    seen = seen_depths(view, np.concatenate([near, far]))
    assert set(np.unique(seen[np.isfinite(seen)])) == {2.0}


def test_thinned_points_are_even_in_space() -> None:
    """One half of the line has a hundred times as many points as the other."""
    random = np.random.default_rng(0)
    places = np.concatenate([random.uniform(0, 1, 10_000), random.uniform(1, 2, 100)])
    points = np.column_stack([places, np.zeros((len(places), 2))])
    errors = random.uniform(0, 1, len(places))
    rows = thinned(points, errors, 100)
    assert 90 <= len(rows) <= 100
    assert (points[rows, 0] < 1).mean() == pytest.approx(0.5, abs=0.15)
    assert errors[rows][points[rows, 0] < 1].max() < 0.1  # the best of each cell
    assert len(thinned(points, errors, 20_000)) == len(points)


def test_a_mesh_is_read_by_trimesh(tmp_path: Path, pycolmap) -> None:
    """The surface of a ball, coloured by place."""
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh")
    normals = np.random.default_rng(0).normal(size=(8000, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.rint((normals + 1) * 127).astype(np.uint8)
    ball = PointCloud(2 * normals + [10, 20, 30], colors, "m", EAST_NORTH_UP, normals)
    write_mesh(SimpleNamespace(dense=ball), tmp_path, tmp_path)
    plain = trimesh.load(tmp_path / "mesh.ply", process=False)
    glb = trimesh.load(tmp_path / "mesh.glb", process=False, force="mesh")
    np.testing.assert_allclose(np.linalg.norm(plain.vertices - [10, 20, 30], axis=1), 2, atol=0.05)
    np.testing.assert_array_equal(plain.faces, glb.faces)
    np.testing.assert_allclose(  # east, up, south
        glb.vertices, plain.vertices[:, [0, 2, 1]] * [1, 1, -1], atol=1e-5
    )
    assert plain.volume == pytest.approx(4 / 3 * np.pi * 8, rel=0.01)
    expected = (plain.vertices - [10, 20, 30] + 2) / 2 * 127
    assert np.abs(plain.visual.vertex_colors[:, :3] - expected).mean() < 4


def test_too_few_points_make_no_mesh(tmp_path: Path, pycolmap) -> None:
    points = np.eye(3, dtype=np.float32)
    few = PointCloud(points, np.zeros((3, 3), np.uint8), "m", EAST_NORTH_UP, points)
    with pytest.raises(ReconstructionError):
        write_mesh(SimpleNamespace(dense=few), tmp_path, tmp_path)
    assert not list(tmp_path.iterdir())


def test_transforms_name_files_from_where_they_lie(tmp_path: Path) -> None:
    """Also if the folder is a link to one elsewhere."""
    (tmp_path / "far" / "away").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "far" / "away")
    (tmp_path / "a.jpg").touch()
    path, camera = tmp_path / "link" / "transforms.json", Camera((640, 480), 600.0)
    write_transforms(
        path,
        {"a.jpg": PosedView("a.jpg", camera, np.eye(3), np.zeros(3))},
        {"a.jpg": CameraIntrinsics.of_camera(camera)},
        {"file_path": {"a.jpg": tmp_path / "a.jpg"}},
        tmp_path / "link" / "model.ply",
    )
    values = json.loads(path.read_text())
    assert os.path.exists(tmp_path / "link" / values["frames"][0]["file_path"])
    assert values["ply_file_path"] == "model.ply"


def test_formats_are_checked_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pycolmap
) -> None:
    for formats in (("laz", "shp"), ("lazz",)):
        with pytest.raises(OptionError):
            reconstruct_many(tmp_path, tmp_path / "m", options=MultiViewOptions(formats=formats))
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "laspy" else find(name)
    )
    with pytest.raises(MissingExtraError, match="laspy"):
        reconstruct_many(tmp_path, tmp_path / "m", options=MultiViewOptions(formats=("laz",)))
