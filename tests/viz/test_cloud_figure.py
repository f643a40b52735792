from __future__ import annotations

import numpy as np
import pytest

from deepdetect._shared.errors import OptionError
from deepdetect.geometry.point_cloud import PointCloud
from deepdetect.viz.draw import CAPTION_HEIGHT
from deepdetect.viz.render import draw_clouds


@pytest.fixture(scope="module")
def cloud(photo: np.ndarray) -> PointCloud:
    y, x = np.indices(photo.shape[:2]).reshape(2, -1)
    points = np.column_stack([x - 127.5, y - 127.5, np.full(x.size, 300.0)])
    return PointCloud(points, photo.reshape(-1, 3), "mm")


def test_all_clouds_are_seen_by_one_camera(photo: np.ndarray, cloud: PointCloud) -> None:
    corner = (cloud.points[:, 0] > 60) & (cloud.points[:, 1] > 60)
    picture = draw_clouds(
        photo, {"corner": cloud[corner], "none": cloud[:0], "all": cloud}, width=200
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


def test_titles_and_counts_are_written_below(photo: np.ndarray, cloud: PointCloud) -> None:
    one, two = (draw_clouds(photo, {"ours": part}, width=200)[200:] for part in (cloud, cloud[::2]))
    assert (one != two).any()
    assert one[:, 206:].max() > 200


def test_panels_can_stand_in_one_row(photo: np.ndarray, cloud: PointCloud) -> None:
    picture = draw_clouds(photo, {"a": cloud, "b": cloud}, width=100, columns=3)
    assert picture.shape == (100 + CAPTION_HEIGHT, 312, 3)


def test_nothing_to_draw_is_an_error(photo: np.ndarray, cloud: PointCloud) -> None:
    with pytest.raises(OptionError, match="no cloud has a point"):
        draw_clouds(photo, {"ours": cloud[:0]})
    other = PointCloud(cloud.points, cloud.colors, "baseline")
    with pytest.raises(OptionError, match="one unit"):
        draw_clouds(photo, {"ours": cloud, "theirs": other})
