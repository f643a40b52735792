from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.viz.draw import CAPTION_HEIGHT
from deepdetect_lab.evaluation.clouds import draw_clouds, orbit_camera, render


def left_camera(size: tuple[int, int], focal_px: float, centre: tuple[float, float]) -> PosedView:
    return PosedView("left", Camera(size, focal_px, centre), np.eye(3), np.zeros(3))


PLAIN = left_camera((80, 60), 50.0, (39.5, 29.5))


@pytest.fixture(scope="module")
def cloud(photo: np.ndarray) -> PointCloud:
    """A photograph on a slanted plane."""
    y, x = np.indices(photo.shape[:2]).reshape(2, -1)
    depth = 800 + 0.5 * x
    ray = np.column_stack([(x - 127.5) / 300, (y - 127.5) / 300, np.ones(x.size)])
    return PointCloud(ray * depth[:, None], photo.reshape(-1, 3), "mm")


def test_projection_is_opencv_s(cloud: PointCloud) -> None:
    camera = orbit_camera(cloud, 30, -20, (320, 240))
    xy, depth = camera.project(cloud.points)
    turn, matrix = cv2.Rodrigues(camera.rotation)[0], camera.camera.matrix
    expected = cv2.projectPoints(cloud.points, turn, camera.translation, matrix, None)[0]
    np.testing.assert_allclose(xy, expected[:, 0], atol=1e-6)
    assert (depth > 0).all()
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1)


def test_from_the_left_camera_the_photograph_comes_back(
    cloud: PointCloud, photo: np.ndarray
) -> None:
    camera = left_camera((256, 256), 300.0, (127.5, 127.5))
    picture = render(cloud, camera).astype(int)
    shifts = [(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)]
    gaps = [np.abs(np.roll(picture, shift, (0, 1)) - photo).mean() for shift in shifts]
    assert gaps[0] < 8
    assert gaps[0] == min(gaps)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "size"), [(0, 0, (200, 150)), (-60, 40, (90, 200))]
)
def test_the_cloud_fills_the_picture(
    cloud: PointCloud, azimuth: float, elevation: float, size: tuple[int, int]
) -> None:
    camera = orbit_camera(cloud, azimuth, elevation, size)
    xy, _ = camera.project(cloud.points)
    inside = ((xy > -0.5) & (xy < np.array(size) - 0.5)).all(1)
    assert inside.mean() > 0.96
    spread = np.percentile(xy, 99, axis=0) - np.percentile(xy, 1, axis=0)
    assert (spread / size).max() == pytest.approx(0.95, abs=0.01)


def test_angles_turn_the_viewer_to_the_right_and_up(cloud: PointCloud) -> None:
    # x right, y down: the viewer on the right has a larger x, the one above a smaller y.
    front = orbit_camera(cloud, 0, 0).centre
    assert orbit_camera(cloud, 30, 0).centre[0] > front[0] + 100
    assert orbit_camera(cloud, 0, 30).centre[1] < front[1] - 100
    np.testing.assert_allclose(front, 0, atol=80)  # near the left camera


def test_wild_points_do_not_change_the_view(cloud: PointCloud) -> None:
    wild = PointCloud(
        np.concatenate([cloud.points, np.full((20, 3), 1e9)]),
        np.concatenate([cloud.colors, np.zeros((20, 3), np.uint8)]),
        "mm",
    )
    plain, other = orbit_camera(cloud), orbit_camera(wild)
    np.testing.assert_allclose(
        other.project(cloud.points)[0], plain.project(cloud.points)[0], atol=3
    )


def test_the_nearest_point_is_seen_whatever_the_order() -> None:
    points = np.array([[0.0, 0, 10], [0, 0, 5], [0, 0, 20], [0, 0, -5]])
    colors = np.array([[40, 0, 0], [80, 0, 0], [120, 0, 0], [160, 0, 0]], np.uint8)
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        picture = render(PointCloud(points[order], colors[order], "mm"), PLAIN)
        assert picture[30, 40, 0] == round((80 + 3 * 255) / 4)  # a quarter of this pixel


def test_a_near_narrow_point_hides_a_wide_far_one() -> None:
    """Points differ in width when the width is left open: nearness alone decides."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, (500, 2)), rng.uniform(5, 20, 500)])
    cloud = PointCloud(points, rng.integers(0, 250, (500, 3)).astype(np.uint8), "mm")
    picture = render(cloud, PLAIN)
    xy, depth = PLAIN.project(points)
    nearest = np.argmin(depth)
    x, y = np.rint(xy[nearest]).astype(int)
    assert picture[y, x].tolist() == cloud.colors[nearest].tolist()


def test_points_become_wider_as_the_viewer_comes_nearer() -> None:
    cloud = PointCloud([[0.5, 0, 5], [-2.0, 0, 10]], np.zeros((2, 3), np.uint8), "mm")
    near = dataclasses.replace(PLAIN, translation=np.array([0.0, 0, -3]))
    ink = (255 - render(cloud, near)[..., 0].astype(float)) / 255
    # 50 pixels of focal length, 0.02 for few points, 1.4 of overlap; in half pixels.
    assert ink[:, 40:].sum() == pytest.approx((round(2 * 1.4 * 5 / 2) / 2) ** 2, rel=0.01)
    assert ink[:, :40].sum() == pytest.approx((round(2 * 1.4 * 10 / 7) / 2) ** 2, rel=0.01)


def test_dense_points_close_a_surface(cloud: PointCloud) -> None:
    camera = orbit_camera(cloud, 20, 10, (300, 300))
    grey = PointCloud(cloud.points, np.zeros_like(cloud.colors), "mm")
    picture = render(grey, camera)
    xy, _ = camera.project(cloud.points)
    hull = np.zeros((300, 300), np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(xy).astype(np.int32)), 1)
    inner = cv2.erode(hull, np.ones((9, 9), np.uint8)) > 0
    assert (picture[inner] == 0).mean() > 0.999


@pytest.fixture(scope="module")
def flat_cloud(photo: np.ndarray) -> PointCloud:
    y, x = np.indices(photo.shape[:2]).reshape(2, -1)
    points = np.column_stack([x - 127.5, y - 127.5, np.full(x.size, 300.0)])
    return PointCloud(points, photo.reshape(-1, 3), "mm")


def test_all_clouds_are_seen_by_one_camera(photo: np.ndarray, flat_cloud: PointCloud) -> None:
    corner = (flat_cloud.points[:, 0] > 60) & (flat_cloud.points[:, 1] > 60)
    picture = draw_clouds(
        photo, {"corner": flat_cloud[corner], "none": flat_cloud[:0], "all": flat_cloud}, width=200
    )
    height = 200 + CAPTION_HEIGHT
    assert picture.shape == (2 * height + 6, 406, 3)
    left, few = picture[:200, :200], picture[:200, 206:]
    none, full = picture[height + 6 : height + 206, :200], picture[height + 6 : height + 206, 206:]
    assert np.abs(left.astype(int).mean((0, 1)) - photo.mean((0, 1))).max() < 2
    assert (none == 255).all()
    # The corner is drawn where it lies in the whole: on the right, below.
    rows, columns = np.nonzero((few < 255).any(2))
    assert rows.min() > 100
    assert columns.min() > 100
    inside = (slice(rows.min() + 5, rows.max() - 5), slice(columns.min() + 5, columns.max() - 5))
    assert np.abs(few[inside].astype(int) - full[inside]).mean() < 3
