from __future__ import annotations

import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.geometry.point_cloud import PointCloud, angular_spacing, robust_box


def test_types_are_kept_and_lists_are_taken() -> None:
    points = np.ones((4, 3), np.float32)
    cloud = PointCloud(points, np.zeros((4, 3), np.uint8), "mm")
    assert cloud.points is points
    listed = PointCloud([[1.0, 2, 3]], [[255, 0, 9]], "baseline")
    assert listed.points.dtype == np.float64
    assert listed.colors.dtype == np.uint8


def test_slices_masks_and_numbers_select_points() -> None:
    cloud = PointCloud(np.arange(12.0).reshape(4, 3), np.zeros((4, 3), np.uint8), "mm")
    assert len(cloud) == 4
    assert cloud[cloud.points[:, 0] > 5].points[:, 0].tolist() == [6, 9]
    assert cloud[1].points.tolist() == [[3, 4, 5]]
    assert cloud[:2].unit == "mm"


@pytest.mark.parametrize(
    ("points", "colors", "unit"),
    [
        (np.zeros((3, 2)), np.zeros((3, 2), np.uint8), "mm"),
        (np.zeros((3, 3), int), np.zeros((3, 3), np.uint8), "mm"),
        (np.zeros((3, 3)), np.zeros((3, 3)), "mm"),
        (np.zeros((1, 3)), [[0, 0, 256]], "mm"),
        (np.full((1, 3), np.nan), [[0, 0, 0]], "mm"),
        (np.full((1, 3), 1e39), [[0, 0, 0]], "mm"),
        (np.zeros((1, 3)), [[0, 0, 0]], "baselin"),
    ],
)
def test_mistakes_are_refused(points, colors, unit: str) -> None:
    with pytest.raises(OptionError):
        PointCloud(points, colors, unit)


def test_normals_have_the_shape_of_the_points() -> None:
    points, colors = np.zeros((3, 3)), np.zeros((3, 3), np.uint8)
    cloud = PointCloud(points, colors, "mm", normals=[[0, 0, 1], [0, 1, 0], [1, 0, 0]])
    assert cloud.normals.dtype == np.float32
    assert cloud[1].normals.tolist() == [[0, 1, 0]]
    for shape in ((2, 3), (3, 2), (3,), (3, 3, 1)):
        with pytest.raises(OptionError):
            PointCloud(points, colors, "mm", normals=np.zeros(shape))


def test_a_few_wild_points_hardly_move_the_box() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (1000, 3))
    wild = points.copy()
    wild[:4] = [[1e8, 0, 0], [0, -1e8, 0], [0, 0, 1e8], [1e30, 1e30, 1e30]]
    grey = np.zeros((1000, 3), np.uint8)
    plain, moved = (robust_box(PointCloud(p, grey, "mm")) for p in (points, wild))
    np.testing.assert_allclose(moved.centre, plain.centre, atol=0.02)
    assert moved.radius == pytest.approx(plain.radius, rel=0.02)
    assert plain.radius == pytest.approx(np.sqrt(3) * 0.98, rel=0.03)


def test_spacing_is_that_of_the_pixels_at_any_depth() -> None:
    y, x = np.indices((200, 300)).reshape(2, -1)
    rng = np.random.default_rng(0)
    depth = rng.uniform(500, 3000, x.size)
    ray = np.column_stack([(x - 150) / 400, (y - 100) / 400, np.ones(x.size)])
    cloud = PointCloud(ray * depth[:, None], np.zeros((x.size, 3), np.uint8), "mm")
    assert angular_spacing(cloud) == pytest.approx(1 / 400, rel=0.03)
    # A quarter of the points lie twice as far apart.
    assert angular_spacing(cloud[rng.permutation(x.size)[::4]]) == pytest.approx(2 / 400, rel=0.05)
