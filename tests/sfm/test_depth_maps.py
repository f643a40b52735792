"""Depth maps of made images, whose depth is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.io.image_file import read_with, reading_options
from deepdetect.sfm import depth_maps
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.depth_maps import depth_map, find_references, limited_view
from deepdetect.sfm.mapping import RegisteredImage, SparseModel

SIZE = (320, 240)


def view(x: float, name: str = "") -> PosedView:
    """Return a camera at (x, 0, 0) that looks ahead."""
    return PosedView(name, Camera(SIZE, 300.0), np.eye(3), np.array([-x, 0, 0]))


def test_neighbours_share_points_at_a_good_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_maps, "NEIGHBOURS", 2)
    points = np.random.default_rng(0).uniform((-1, -1, 5.5), (1, 1, 6.5), (200, 3))

    def model(step: int) -> SparseModel:
        """Cameras that see every so many of the points."""
        rows = np.arange(0, 200, step)
        images = {}
        for x in (0.0, 0.02, 0.6, 1.2, 9.0):
            own = view(x, str(x))
            intrinsics = CameraIntrinsics.of_camera(own.camera)
            xy = own.project(points[rows])[0]
            images[own.name] = RegisteredImage(own, intrinsics, rows, xy)
        return SparseModel(images, points, np.zeros((200, 3)), np.zeros(200), np.full(200, 5))

    found = {first.view.name: others for first, *others in find_references(model(1))}
    assert {each.view.name for each in found["0.0"]} == {"0.6", "1.2"}
    assert find_references(model(10)) == []


def test_the_depth_of_a_steep_ground_is_found(tmp_path: Path) -> None:
    """Four cameras 1.5 above a textured plane: matches move by up to a pixel per row."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, (1200, 1200)).astype(np.float32), (0, 0), 1.2)
    texture = (texture - texture.mean()) * 3 + 128
    camera = Camera(SIZE, 300.0)
    tilt = np.deg2rad(25)
    rotation = np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    y, x = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    xy = np.column_stack([x.ravel(), y.ravel()])
    points = np.column_stack([rng.uniform(-2, 2, 200), np.full(200, 1.5), rng.uniform(2, 8, 200)])
    images = []
    for number, place in enumerate((0.0, -0.4, 0.4, 0.8)):
        own = PosedView(f"{number}.png", camera, rotation, -rotation @ [place, 0, 0])
        rays = camera.rays(xy) @ rotation
        ground = own.centre + rays * (1.5 / rays[:, 1:2])
        u, v = (150 * (ground[:, 0] + 4)), 150 * ground[:, 2] - 200
        seen = cv2.remap(
            texture, *(each.reshape(y.shape).astype(np.float32) for each in (u, v)), cv2.INTER_CUBIC
        )
        Image.fromarray(seen.clip(0, 255).astype(np.uint8)).save(tmp_path / own.name)
        rows = np.flatnonzero(own.project(points)[1] > 0)
        xys = own.project(points[rows])[0]
        images.append(RegisteredImage(own, CameraIntrinsics.of_camera(camera), rows, xys))
    made = depth_map(tmp_path, images, points, 2)
    rays = camera.rays(np.column_stack([x[::2, ::2].ravel(), y[::2, ::2].ravel()]))
    inverse = ((rays @ rotation)[:, 1] / 1.5).reshape(made.shape)
    moved = 300 * 0.8 * (made["plane"][..., 0] - inverse)  # pixels in the farthest image
    inside = np.s_[30:-10, 20:-60]
    assert np.mean(np.abs(moved[inside]) < 1) > 0.9  # not where it is NaN
    assert np.nanmedian(np.abs(moved[inside])) < 0.2
    slope = np.nanmedian(made["plane"][inside][..., 2])
    np.testing.assert_allclose(slope, np.diff(inverse[:, 0]).mean() / 2, rtol=0.05)


def test_depth_goes_on_between_textures_and_not_beyond(tmp_path: Path) -> None:
    """A wall 6 away with plain stripes, under a plain sky; each image has its own noise."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (240, 480)).astype(np.float32), (0, 0), 1.2)
    wall = (wall - wall.mean()) * 3 + 128
    wall[:100] = wall[150:170] = wall[100:, 310:335] = 180
    camera = Camera(SIZE, 300.0)
    points = np.column_stack([rng.uniform(-2, 2, 200), rng.uniform(0, 2, 200), np.full(200, 6.0)])
    points[::2, 2] = rng.uniform(5, 8, 100)
    images = []
    for number, place in enumerate((0, -0.4, 0.4, 0.8)):
        own = PosedView(f"{number}.png", camera, np.eye(3), np.array([-place, 0, 0]))
        left = 80 + round(place * 300 / 6)
        seen = wall[:, left : left + SIZE[0]] + rng.normal(0, 1.5, SIZE[::-1])
        Image.fromarray(seen.clip(0, 255).astype(np.uint8)).save(tmp_path / own.name)
        rows, xy = np.arange(200), own.project(points)[0]
        images.append(RegisteredImage(own, CameraIntrinsics.of_camera(camera), rows, xy))
    inverse = depth_map(tmp_path, images, points, 2)["plane"][..., 0]
    assert np.isfinite(inverse[10:40, 20:-40]).mean() < 0.05
    assert np.isfinite(inverse[44:49, 20:-40]).mean() < 0.2  # beside the wall
    error = np.abs(6 * inverse - 1)[55:-6, 20:-40]
    assert np.mean(error < 0.05) > 0.95
    for stripe in (error[20:30], error[:, 95:107]):
        assert np.mean(stripe < 0.05) > 0.6


def test_a_smaller_view_sees_the_same_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    own = view(0.5)
    assert limited_view(own) is own
    monkeypatch.setattr(depth_maps, "MAX_SIDE_PX", 160)
    small = limited_view(own)
    assert small.camera.size == (160, 120)
    points = np.array([[0.3, -0.2, 6.0]])
    expected = (own.project(points)[0] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(small.project(points)[0], expected)


def test_what_was_extracted_is_not_too_large(tmp_path: Path, photo: np.ndarray) -> None:
    Image.fromarray(photo).save(tmp_path / "a.png")
    camera = CameraIntrinsics("PINHOLE", photo.shape[1::-1], (1.0, 1.0, 0.0, 0.0))
    limited = reading_options(max_megapixels=1e-3)
    with read_with(limited):  # as in another process than that of the command
        rgb = depth_maps._undistorted(tmp_path / "a.png", (0, 0), camera, camera.pinhole, limited)
    np.testing.assert_array_equal(rgb, photo)
