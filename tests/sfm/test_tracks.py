"""Tracks of a slanted plane with a texture, whose matches are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect._shared.opencv import cv2
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm.colmap import CameraIntrinsics
from deepdetect.sfm.fusion import DENSE_POINT
from deepdetect.sfm.mapping import read_sparse_model
from deepdetect.sfm.tracks import add_dense_tracks, refine_tracks

SIZE, NORMAL, DISTANCE = (320, 240), np.array([-0.2, 0, 1]), 6.0
"""The plane z = 6 + x / 5 has this normal and this distance from the camera."""


def view(x: float) -> PosedView:
    rotation = cv2.Rodrigues(np.array([0, -x / DISTANCE, 0.05 * x]))[0]
    return PosedView(f"{x:g}.png", Camera(SIZE, 300.0), rotation, -rotation @ [x, 0, 0])


VIEWS = [view(x) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]


def on_plane(own: PosedView, xy: np.ndarray) -> np.ndarray:
    rays = own.camera.rays(xy) @ own.rotation
    return own.centre + rays * ((DISTANCE - own.centre @ NORMAL) / (rays @ NORMAL))[:, None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    noise = np.random.default_rng(0).normal(0, 1, (1000, 1000, 3)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 3)
    texture = np.clip(128 + 50 * texture / texture.std(), 0, 255)
    y, x = np.indices(SIZE[::-1])
    for own in VIEWS:
        places = on_plane(own, np.column_stack([x.ravel(), y.ravel()]).astype(float))
        at = (places[:, :2] * 80 + 500).astype(np.float32).reshape(*SIZE[::-1], 2)
        image = cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_CUBIC)
        cv2.imwrite(str(tmp_path / own.name), np.rint(image).clip(0, 255).astype(np.uint8))
    return tmp_path


@pytest.fixture
def model(pycolmap):
    """Keypoints of 60 points with noise; the outer images see 12 of them, the others all."""
    rng = np.random.default_rng(1)
    points = on_plane(VIEWS[2], rng.uniform((40, 40), (280, 200), (60, 2)))
    made = pycolmap.Reconstruction()
    camera = CameraIntrinsics.of_camera(Camera(SIZE, 300.0)).colmap_camera()
    camera.camera_id = 1
    made.add_camera_with_trivial_rig(camera)
    for number, own in enumerate(VIEWS, 1):
        xy = own.project(points)[0] + rng.normal(0, 0.5, (60, 2)) + 0.5
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(own.rotation), own.translation)
        image = pycolmap.Image(name=own.name, keypoints=xy, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in (1, 2, 3, 4, 5) if row < 12 else (2, 3, 4):
            track.add_element(number, row)
        made.add_point3D(point, track)
    return made


def test_rough_keypoints_become_exact_tracks_of_all_images(model, folder: Path) -> None:
    assert distances(read_sparse_model(model)) > 0.3
    refine_tracks(model, folder)
    sparse = read_sparse_model(model)
    assert len(sparse.points) > 55
    assert sparse.tracks.mean() > 2.5
    assert distances(sparse) < 0.1
    seen = sparse.images["0.png"]
    column, row = np.rint(seen.xy).astype(int).T
    image = cv2.imread(str(folder / "0.png"))[row, column, ::-1].astype(int)
    assert np.median(np.abs(image - sparse.colors[seen.points])) < 10


def test_dense_points_become_tracks_that_images_share(model, folder: Path) -> None:
    y, x = np.mgrid[20:220:2, 20:300:2]
    fused = []
    for own in VIEWS:
        found = np.zeros(x.size, DENSE_POINT)
        found["points"] = on_plane(own, np.column_stack([x.ravel(), y.ravel()]).astype(float))
        found["normals"] = -NORMAL / np.linalg.norm(NORMAL)
        fused.append((own, found))
    add_dense_tracks(model, folder, fused)
    sparse = read_sparse_model(model)
    assert len(sparse.points) > 1000
    assert sparse.tracks.mean() > 3.8
    assert distances(sparse) < 0.05
    # What images share is one point, not one from each.
    assert len(sparse.points) < 2 * len(sparse.images["0.png"].points)


def test_tracks_stay_where_no_dense_one_is_near(model, folder: Path) -> None:
    before = read_sparse_model(model).images["0.png"].xy
    own = VIEWS[2]
    y, x = np.mgrid[20:220:2, 20:150:2]
    found = np.zeros(x.size, DENSE_POINT)
    found["points"] = on_plane(own, np.column_stack([x.ravel(), y.ravel()]).astype(float))
    found["normals"] = -NORMAL / np.linalg.norm(NORMAL)
    add_dense_tracks(model, folder, [(own, found)])
    xy = read_sparse_model(model).images["0.png"].xy
    dense = (np.abs(xy / 2 - np.rint(xy / 2)) < 1e-3).all(axis=1)
    assert dense.sum() > 300
    stayed = xy[~dense]
    assert (stayed[:, 0] > 155).sum() > 0.6 * (before[:, 0] > 155).sum()
    assert (stayed[:, 0] < 140).sum() < 0.3 * (before[:, 0] < 140).sum()


def distances(sparse) -> float:
    """Return how far, in pixels, the points of the plane lie apart that images of a track see."""
    middles, seen = np.zeros_like(sparse.points), []
    for image in sparse.images.values():
        seen.append((image.points, on_plane(image.view, image.xy)))
        middles[image.points] += seen[-1][1] / sparse.tracks[image.points, None]
    apart = [np.linalg.norm(places - middles[rows], axis=1) for rows, places in seen]
    return float(np.median(np.concatenate(apart)) * 300 / DISTANCE)
