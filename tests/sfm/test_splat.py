"""Splats of cameras whose principal point is not in the middle of the image."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from deepdetect import ReconstructionError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.mapping import read_sparse_model
from deepdetect.sfm.splat import write_splat

SIZE = (160, 121)
CENTRED = ("SIMPLE_RADIAL", [150.0, 80.0, 60.5, -0.05])
CAMERAS = {
    "pinhole": ("PINHOLE", [150.0, 152.0, 86.3, 55.1]),
    "half pixel": ("SIMPLE_PINHOLE", [150.0, 79.5, 60.5]),
    "radial": ("SIMPLE_RADIAL", [150.0, 73.2, 66.4, -0.05]),
    "lens": ("OPENCV", [150.0, 148.0, 85.7, 61.9, 0.03, -0.01, 0.001, -0.002]),
    "centred": CENTRED,
    "centred pinhole": ("PINHOLE", [150.0, 152.0, 80.0, 60.5]),
}
LEVELS_PER_RAY = np.array([[137.0, 40.0], [-40.0, 137.0]])
"""Red and green of an image are 128 plus this times (x, y) of the ray through a pixel."""


class Splat(NamedTuple):
    """A written splat, its folder, the model, and the sparse model before."""

    folder: Path
    found: Any
    before: Any
    after: Any


@pytest.fixture(scope="module", params=CAMERAS)
def splat(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Splat:
    """Write one of three images that show the rays, and 60 points."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")
    root = tmp_path_factory.mktemp("splat")
    kind, numbers = CAMERAS[request.param]
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=3, num_points3D=60)
    options.camera_width, options.camera_height = SIZE
    options.camera_model_id = getattr(pycolmap.CameraModelId, kind)
    options.camera_params = numbers
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    noise = np.random.default_rng(0).uniform(-8, 8, (*SIZE[::-1], 3))
    y, x = np.indices(SIZE[::-1])
    pixels = np.column_stack([x.ravel(), y.ravel()]) + 0.5
    for image in model.images.values():
        rays = np.asarray(image.camera.cam_from_img(pixels)).reshape(*SIZE[::-1], 2)
        rgb = 128 + noise  # so that rounding has no preferred direction
        rgb[..., :2] += rays @ LEVELS_PER_RAY
        Image.fromarray(np.rint(rgb).clip(0, 255).astype(np.uint8)).save(root / image.name)
    (root / "sparse" / "0").mkdir(parents=True)
    model.write(root / "sparse" / "0")
    sparse = read_sparse_model(model, {image.name: "given" for image in model.images.values()})
    cloud = PointCloud(sparse.points, sparse.colors, "m", "world")
    found = SimpleNamespace(
        intrinsics={name: image.intrinsics for name, image in sparse.images.items()},
        **{"views": sparse.views, "sparse": cloud, "cloud": cloud, "dense": cloud},
        dense_errors=np.ones(len(cloud), np.float32),
    )
    quiet = request.param.startswith("centred")
    with nullcontext() if quiet else pytest.warns(UserWarning, match="cropped"):
        write_splat(found, root, root)
    folder = root / "splat"
    return Splat(folder, found, model, pycolmap.Reconstruction(folder / "sparse" / "0"))


def test_the_principal_point_is_in_the_middle(splat: Splat) -> None:
    for camera in splat.after.cameras.values():
        assert camera.model_name == "PINHOLE"
        assert camera.principal_point_x == pytest.approx(camera.width / 2, abs=1e-6)
        assert camera.principal_point_y == pytest.approx(camera.height / 2, abs=1e-6)
    for frame in json.loads((splat.folder / "transforms.json").read_text())["frames"]:
        assert (frame["cx"], frame["cy"]) == pytest.approx((frame["w"] / 2, frame["h"] / 2))


def test_points_are_where_the_images_observe_them(splat: Splat) -> None:
    """As the first program projects them: it knows the focal lengths and the size."""
    count = 0
    for image in splat.after.images.values():
        focal = image.camera.focal_length_x, image.camera.focal_length_y
        size = np.array([image.camera.width, image.camera.height])
        for seen in image.points2D:
            if seen.has_point3D():
                point = image.cam_from_world() * splat.after.points3D[seen.point3D_id].xyz
                np.testing.assert_allclose(
                    point[:2] / point[2] * focal + size / 2, seen.xy, atol=1e-3
                )
                count += 1
    assert count == sum(image.num_points3D for image in splat.before.images.values()) > 100


def test_pixels_show_the_rays_of_the_camera(splat: Splat) -> None:
    for image in splat.after.images.values():
        camera = image.camera
        with Image.open(splat.folder / "images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height)
            rgb = np.asarray(picture).astype(float)
        y, x = np.indices(rgb.shape[:2])
        across = (x + 0.5 - camera.width / 2) / camera.focal_length_x
        down = (y + 0.5 - camera.height / 2) / camera.focal_length_y
        expected = 128 + np.stack([across, down], axis=2) @ LEVELS_PER_RAY
        difference = (rgb[..., :2] - expected)[4:-4, 4:-4]  # Lanczos reads beyond the border
        for rows in np.array_split(difference, 2):
            for part in np.array_split(rows, 2, axis=1):
                assert np.abs(part.mean(axis=(0, 1))).max() < 0.25  # a pixel is about a level
        assert rgb.min() > 0  # no empty border


def test_no_more_is_cut_off_than_is_needed(splat: Splat) -> None:
    for image in splat.after.images.values():
        own = splat.found.intrinsics[image.name]
        straight = own.without_border
        cx, cy = np.add(straight.pinhole.centre, 0.5)
        least = 2 * min(cx, straight.size[0] - cx), 2 * min(cy, straight.size[1] - cy)
        size = np.array([image.camera.width, image.camera.height])
        assert (size <= np.add(least, 1e-6)).all()
        assert (size > np.subtract(least, 1)).all()


def test_depths_lie_where_points_are(splat: Splat) -> None:
    values = json.loads((splat.folder / "transforms.json").read_text())
    for frame in values["frames"]:
        with Image.open(splat.folder / frame["depth_file_path"]) as image:
            assert image.size == (frame["w"], frame["h"])
            depths = np.asarray(image) * values["depth_unit_scale_factor"]
        camera = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        x, y, z = camera[:3, :3] @ splat.found.cloud.points.T + camera[:3, 3:]
        column = frame["fl_x"] * x / z + frame["w"] / 2
        row = frame["fl_y"] * y / z + frame["h"] / 2
        inside = (z > 0) & (column > 0) & (row > 0)
        inside &= (column < frame["w"]) & (row < frame["h"])
        found = depths[row[inside].astype(int), column[inside].astype(int)]
        known = found > 0
        assert known.sum() > 10
        assert (found[known] <= z[inside][known] + 0.002).all()
        assert np.median(np.abs(found[known] - z[inside][known])) < 0.002


def test_an_image_beside_its_principal_point_is_refused() -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    own = CameraIntrinsics("PINHOLE", SIZE, (150.0, 150.0, -3.0, 60.0))
    with pytest.raises(ReconstructionError, match="outside"):
        _ = own.centred
