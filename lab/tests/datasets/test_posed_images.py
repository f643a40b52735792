"""The tests write two cameras in three layouts, with the conventions of each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError
from deepdetect._shared.opencv import import_pycolmap
from deepdetect.io.gps import read_gps
from deepdetect_lab.datasets import load_posed_scenes, posed_images
from deepdetect_lab.datasets.pair_selection import FRAME_DISTANCES
from deepdetect_lab.datasets.posed_images import PosedScene

SIZE = (60, 40)
INTRINSICS = np.array([[50.0, 0, 31.25], [0, 52, 18.5], [0, 0, 1]])
"""Centre of the first pixel (0, 0)."""

TURNS = np.array([[0.0, 0, 0], [0.1, -0.4, 0.05], [2.5, 0.3, -1]])
CENTRES = np.array([[0.0, 0, 0], [1, -0.5, 2], [-4, 2, 1]])


def axes(number: int) -> np.ndarray:
    """Return the axes of a camera in the world, as columns."""
    return cv2.Rodrigues(TURNS[number])[0]


def text(numbers) -> str:
    return " ".join(f"{number:.9f}" for number in np.ravel(numbers))


def write_images(folder: Path, names: str, size: tuple[int, int] = SIZE) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(3):
        Image.new("L", size, 40 * number).save(folder / names.format(number))


def write_strecha(folder: Path, names: str = "{:04d}.png", scale: int = 1) -> Path:
    """The file's camera is of images `scale` times as large, in their pixels."""
    write_images(folder, names)
    large = INTRINSICS.copy()
    large[:2, :2] *= scale
    large[:2, 2] = (INTRINSICS[:2, 2] + 0.5) * scale - 0.5
    for number in range(3):
        rows = (*large, np.zeros(3), *axes(number), CENTRES[number])
        end = f"{SIZE[0] * scale} {SIZE[1] * scale}"
        lines = [*map(text, rows), end]
        (folder / f"{number:04d}.camera").write_text("\n".join(lines) + "\n")
    return folder


def write_kitti(folder: Path, label: str = "P0: ") -> Path:
    write_images(folder, "{:06d}.png")
    first = text(np.column_stack([INTRINSICS, np.zeros(3)]))
    (folder / "calib.txt").write_text(f"{label}{first}\nP1: {text(np.ones(12))}\n")
    poses = [text(np.column_stack([axes(n), CENTRES[n]])) for n in range(3)]
    (folder / "poses.txt").write_text("\n".join(poses))
    return folder


def write_kitti_with_a_matrix(folder: Path) -> Path:
    write_kitti(folder)
    (folder / "calib.txt").unlink()
    (folder / "K.txt").write_text("\n".join(map(text, INTRINSICS)))
    return folder


def write_colmap(folder: Path, model: str = "sparse/0", images: str = "images") -> Path:
    write_images(folder / images, "{:04d}.png")
    place = folder / model
    place.mkdir(parents=True, exist_ok=True)
    numbers = [*np.diag(INTRINSICS)[:2], *(INTRINSICS[:2, 2] + 0.5)]
    (place / "cameras.txt").write_text(
        f"# Camera list\n2 OPENCV 60 40 1 1 1 1 0 0 0 0\n7 PINHOLE 60 40 {text(numbers)}\n"
    )
    lines = ["# Image list", "# of two lines each"]
    for number in (2, 0, 1):  # in any order
        vector = -TURNS[number]  # world to camera
        angle = np.linalg.norm(vector)
        imaginary = np.sinc(angle / (2 * np.pi)) / 2 * vector
        translation = -axes(number).T @ CENTRES[number]
        quaternion = [np.cos(angle / 2), *imaginary]
        lines += [
            f"{number + 1} {text(quaternion)} {text(translation)} 7 {number:04d}.png",
            "" if number else "5.5 6.5 -1 7 8 12",
        ]
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    (place / "points3D.txt").touch()
    return folder


@pytest.fixture(autouse=True)
def near_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posed_images, "FRAME_DISTANCES", (1, 2))


def write_binary_colmap(folder: Path) -> Path:
    place = write_colmap(folder) / "sparse" / "0"
    import_pycolmap().Reconstruction(place).write_binary(place)
    for file in place.glob("*.txt"):
        file.unlink()
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    "strecha": write_strecha,
    "kitti": write_kitti,
    "kitti with K.txt": write_kitti_with_a_matrix,
    "colmap": write_colmap,
    "binary colmap": write_binary_colmap,
}


def load(folder: Path) -> PosedScene:
    (scene,) = load_posed_scenes(folder)
    return scene


@pytest.mark.parametrize("layout", WRITERS)
def test_the_same_cameras_in_each_layout(layout: str, tmp_path: Path) -> None:
    scene = load(WRITERS[layout](tmp_path / "scene"))
    assert scene.name == "scene"
    assert [image.path.stem[-4:] for image in scene.images] == ["0000", "0001", "0002"]
    for number, image in enumerate(scene.images):
        np.testing.assert_allclose(image.camera.matrix, INTRINSICS, atol=1e-6)
        np.testing.assert_allclose(image.rotation, axes(number).T, atol=1e-6)
        # The centre of a camera lies at its own origin.
        own = image.rotation @ CENTRES[number] + image.translation
        np.testing.assert_allclose(own, 0, atol=1e-6)
    found = {(pair.first.path.stem[-1], pair.second.path.stem[-1]) for pair in scene.pairs}
    assert found == {("0", "1"), ("0", "2"), ("1", "2")}


@pytest.mark.parametrize("layout", WRITERS)
def test_projected_points_lie_on_epipolar_lines(layout: str, tmp_path: Path) -> None:
    """World points, seen by both cameras of a pair."""
    world = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    for pair in load(WRITERS[layout](tmp_path)).pairs:
        seen = []
        for image in (pair.first, pair.second):
            local = world @ image.rotation.T + image.translation
            seen.append(local)
        np.testing.assert_allclose(seen[1], seen[0] @ pair.rotation.T + pair.translation, atol=1e-9)
        first, second = (
            points @ image.camera.matrix.T / points[:, 2:]
            for points, image in zip(seen, (pair.first, pair.second), strict=True)
        )
        algebraic = np.einsum("ni,ij,nj->n", second, pair.fundamental, first)
        scale = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        np.testing.assert_allclose(algebraic / scale, 0, atol=1e-9)


def test_intrinsics_are_scaled_to_the_image_by_pixels_as_areas(tmp_path: Path) -> None:
    """The left edge, at -0.5, stays there; the principal point is at the same part of the width."""
    scene = load(write_strecha(tmp_path, scale=2))
    np.testing.assert_allclose(scene.images[1].camera.matrix, INTRINSICS, atol=1e-6)
    first, second = (load(write_strecha(tmp_path / name)) for name in ("a", "b"))
    write_images(tmp_path / "b", "{:04d}.png", (30, 20))
    half = load(tmp_path / "b").images[0].camera.matrix
    np.testing.assert_allclose(half[:2, :2], INTRINSICS[:2, :2] / 2)
    np.testing.assert_allclose(half[:2, 2], [15.375, 9.0])  # (31.25 + .5) / 2 - .5
    np.testing.assert_array_equal(first.images[0].camera.matrix, second.images[0].camera.matrix)


def test_kitti_poses_belong_to_numbers_not_to_the_order(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path)
    (folder / "000000.png").unlink()
    scene = load(folder)
    np.testing.assert_allclose(scene.images[0].rotation, axes(1).T, atol=1e-6)
    assert [pair.name for pair in scene.pairs] == [f"{folder.name} 000001-000002"]


def test_kitti_images_of_another_camera_lie_beside_the_first(tmp_path: Path) -> None:
    """As of the right camera, at half a metre, whose column is -f * 0.5."""
    folder = write_kitti(tmp_path)
    projection = INTRINSICS @ np.column_stack([np.eye(3), [-0.5, 0, 0]])
    (folder / "calib.txt").write_text(f"P1: {text(projection)}")
    image = load(folder).images[1]
    own = image.rotation @ (CENTRES[1] + axes(1) @ [0.5, 0, 0]) + image.translation
    np.testing.assert_allclose(own, 0, atol=1e-6)


def test_a_simple_pinhole_has_one_focal_length(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, ".", ".")
    (folder / "cameras.txt").write_text("7 SIMPLE_PINHOLE 120 80 100 60.5 40.5\n")
    expected = [[50, 0, 29.75], [0, 50, 19.75], [0, 0, 1]]  # 60.5 / 2 - .5
    np.testing.assert_allclose(load(folder).images[0].camera.matrix, expected)


SIMPLE, DOUBLE = "50 30.5 20.5", "50 52 31.75 19"
UNDISTORTED = {
    "SIMPLE_RADIAL": f"{SIMPLE} 0",
    "RADIAL": f"{SIMPLE} 0 0",
    "OPENCV": f"{DOUBLE} 0 0 0 0",
    "FULL_OPENCV": f"{DOUBLE} 0 0 0 0 0 0 0 0",
    "RADIAL printed with few digits": f"{SIMPLE} 1e-9 -1e-10",
}
NO_PINHOLES = {
    "SIMPLE_RADIAL": f"{SIMPLE} 0.01",
    "OPENCV": f"{DOUBLE} 0 0 0.001 0",
    "FULL_OPENCV": f"{DOUBLE} 0 0 0 0 0 0 0 0.1",
    "FOV": f"{DOUBLE} 0.5",
    "SIMPLE_RADIAL_FISHEYE": f"{SIMPLE} 0",
    "RADIAL_FISHEYE": f"{SIMPLE} 0 0",
    "OPENCV_FISHEYE": f"{DOUBLE} 0 0 0 0",
    "THIN_PRISM_FISHEYE": f"{DOUBLE} 0 0 0 0 0 0 0 0",
}


@pytest.mark.parametrize("case", UNDISTORTED)
def test_lens_models_without_distortion_are_pinholes(case: str, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, ".", ".")
    model, numbers = case.split()[0], UNDISTORTED[case]
    (folder / "cameras.txt").write_text(f"7 {model} 60 40 {numbers}\n")
    simple = numbers.startswith(SIMPLE)
    fy, cx, cy = (50, 30.0, 20.0) if simple else (52, 31.25, 18.5)
    expected = [[50, 0, cx], [0, fy, cy], [0, 0, 1]]
    np.testing.assert_allclose(load(folder).images[0].camera.matrix, expected)


@pytest.mark.parametrize("model", NO_PINHOLES)
def test_distortion_and_fisheyes_are_refused(model: str, tmp_path: Path) -> None:
    folder = write_colmap(tmp_path, ".", ".")
    (folder / "cameras.txt").write_text(f"7 {model} 60 40 {NO_PINHOLES[model]}\n")
    with pytest.raises(ImageError, match=model):
        load(folder)


def test_scenes_are_the_folder_or_its_subfolders(tmp_path: Path) -> None:
    for name, write in WRITERS.items():
        write(tmp_path / name)
    (tmp_path / "empty").mkdir()
    assert [scene.name for scene in load_posed_scenes(tmp_path)] == sorted(WRITERS)
    assert [scene.name for scene in load_posed_scenes(tmp_path / "kitti")] == ["kitti"]


def damage(folder: Path, name: str, old: str, new: str) -> None:
    content = (folder / name).read_text()
    assert old in content
    (folder / name).write_text(content.replace(old, new, 1))


DAMAGES = {
    "a word": ("strecha", "0001.camera", "60 40", "60 x40"),
    "no number": ("strecha", "0001.camera", "50.000000000", "nan"),
    "another shape": ("strecha", "0001.camera", "60 40", "60 50"),
    "no focal length": ("strecha", "0001.camera", "50.000000000", "0"),
    "no rotation": ("strecha", "0000.camera", "1.000000000 0", "1.1 0"),
    "mirrored": ("kitti", "poses.txt", "1.000000000 ", "-1.000000000 "),
    "no calibration": ("kitti", "calib.txt", "P0:", "\nP0:"),
    "joined lines": ("kitti", "poses.txt", "\n", " "),
    "distortion": ("colmap", "sparse/0/cameras.txt", "7 PINHOLE", "7 SIMPLE_RADIAL"),
    "another camera": ("colmap", "sparse/0/cameras.txt", "7 PINHOLE", "8 PINHOLE"),
    "a word in a pose": ("colmap", "sparse/0/images.txt", "1 1.000000000", "1 x"),
    "no image": ("colmap", "sparse/0/images.txt", "0001.png", "0009.png"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_files_are_named_in_one_sentence(case: str, tmp_path: Path) -> None:
    layout, name, old, new = DAMAGES[case]
    folder = WRITERS[layout](tmp_path / "scene")
    damage(folder, name, old, new)
    with pytest.raises(ImageError, match=str(tmp_path)):
        load_posed_scenes(folder)


def test_images_that_are_missing_damaged_or_turned_are_refused(tmp_path: Path) -> None:
    folder = write_strecha(tmp_path)
    turned = Image.new("L", SIZE)
    exif = turned.getexif()
    exif[0x0112] = 6
    turned.save(folder / "0001.png", exif=exif)
    with pytest.raises(ImageError):
        load(folder)
    (folder / "0001.png").write_text("no image")
    with pytest.raises(ImageError):
        load(folder)
    (folder / "0001.png").unlink()
    with pytest.raises(ImageError, match=r"0001\.jpg"):
        load(folder)


def test_what_is_no_scene_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ImageError):
            load_posed_scenes(folder)
    (tmp_path / "sparse").mkdir()
    (tmp_path / "sparse" / "images.bin").touch()
    with pytest.raises(ImageError, match="pycolmap"):
        load_posed_scenes(tmp_path)
    folder = write_kitti(tmp_path / "clip")
    monkeypatch.setattr(posed_images, "FRAME_DISTANCES", (7,))
    with pytest.raises(ImageError):
        load_posed_scenes(folder)


def test_the_shared_scenes_are_read(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(posed_images, "FRAME_DISTANCES", FRAME_DISTANCES)
    fountain, clip = (load(shared / "data" / name) for name in ("fountain", "kitti-clip"))
    assert (len(fountain.images), len(fountain.pairs)) == (11, 55)
    expected = [[1379.74, 0, 760.095], [0, 1382.08, 503.155], [0, 0, 1]]
    np.testing.assert_allclose(fountain.images[0].camera.matrix, expected, atol=1e-9)
    # The photographer held it upright: y, down, is the world's z.
    assert all(image.rotation[1, 2] > 0.99 for image in fountain.images)
    assert (len(clip.images), len(clip.pairs)) == (51, 60)
    forward = [-pair.rotation.T @ pair.translation for pair in clip.pairs[:10]]
    np.testing.assert_allclose(forward, np.tile([0, 0, 1.2], (10, 1)), atol=0.04)


def test_satellite_fixes_are_places_in_metres(shared: Path) -> None:
    folder = shared / "data" / "lund"
    with pytest.raises(ImageError):
        load_posed_scenes(folder)
    (scene,) = load_posed_scenes(folder, located=True)
    assert scene.located_only
    assert (len(scene.images), scene.pairs) == (15, ())
    first, last = (read_gps(scene.images[k].path) for k in (0, -1))
    north = np.radians(last.latitude - first.latitude) * 6_381_000  # radii of curvature at 56 deg
    east = np.radians(last.longitude - first.longitude) * 6_393_000
    east *= np.cos(np.radians(first.latitude))
    moved = scene.images[0].translation - scene.images[-1].translation
    np.testing.assert_allclose(moved[:2], (east, north), rtol=0.005, atol=0.05)
