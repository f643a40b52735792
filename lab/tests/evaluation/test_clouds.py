from __future__ import annotations

import numpy as np
import pytest

from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.viz.draw import CAPTION_HEIGHT
from deepdetect_lab.evaluation.clouds import draw_cloud, draw_clouds

RED, BLUE = np.array([[200, 0, 0], [0, 0, 200]], np.uint8)


def plane(depth: float, side: float, color: np.ndarray) -> PointCloud:
    """A square before the left camera."""
    ticks = np.linspace(-side / 2, side / 2, 300)
    x, y = np.stack(np.meshgrid(ticks, ticks)).reshape(2, -1)
    points = np.column_stack([x, y, np.full(x.size, depth)])
    return PointCloud(points, np.tile(color, (x.size, 1)), "mm")


def both(one: PointCloud, other: PointCloud) -> PointCloud:
    points, colors = np.vstack([one.points, other.points]), np.vstack([one.colors, other.colors])
    return PointCloud(points, colors, "mm")


def middle(picture: np.ndarray, color: np.ndarray) -> tuple[float, float]:
    """The mean row and column of a colour."""
    rows, columns = np.nonzero((picture == color).all(2))
    return float(rows.mean()), float(columns.mean())


@pytest.fixture(scope="module")
def cloud() -> PointCloud:
    """A small red square before a large blue one."""
    return both(plane(900, 400, BLUE), plane(700, 100, RED))


def test_what_is_near_hides_what_is_behind_it(cloud: PointCloud) -> None:
    picture = draw_cloud(cloud, 0, 0, (320, 240))
    assert picture.shape == (240, 320, 3)
    np.testing.assert_allclose(middle(picture, RED), (119.5, 159.5), atol=4)
    assert (picture[118:122, 158:162] == RED).all()
    assert (picture[0] == 255).all()
    blue = (picture == BLUE).all(2)
    rows, columns = np.nonzero(blue)
    around = blue[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert 1 - around.mean() < 0.2, "a closed surface, but for the square before it"


def test_from_the_right_and_from_above(cloud: PointCloud) -> None:
    """What is near moves to the left, and down."""
    front, side, above = (
        draw_cloud(cloud, *place, (320, 240)) for place in ((0, 0), (25, 0), (0, 25))
    )
    row, column = (np.subtract(middle(front, RED), middle(front, BLUE))).tolist()
    assert np.subtract(middle(side, RED), middle(side, BLUE))[1] < column - 20
    assert np.subtract(middle(above, RED), middle(above, BLUE))[0] > row + 20


def test_all_clouds_are_seen_from_one_place(cloud: PointCloud, photo: np.ndarray) -> None:
    small = plane(700, 100, RED)
    picture = draw_clouds(photo, {"red": small, "none": small[:0], "all": cloud}, width=200)
    height = 200 + CAPTION_HEIGHT
    assert picture.shape == (2 * height + 6, 406, 3)
    left, red = picture[:200, :200], picture[:200, 206:]
    none, whole = picture[height + 6 : height + 206, :200], picture[height + 6 : height + 206, 206:]
    assert np.abs(left.astype(int).mean((0, 1)) - photo.mean((0, 1))).max() < 2
    assert (none == 255).all()
    np.testing.assert_allclose(middle(red, RED), middle(whole, RED), atol=1)
