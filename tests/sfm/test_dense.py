"""Which images are matched for dense points; their points are tested with the pipeline."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm import dense
from deepdetect.sfm.dense import find_references, limited_view
from deepdetect.sfm.intrinsics import CameraIntrinsics
from deepdetect.sfm.mapping import Observations, SparseModel

SIZE = (320, 240)


def view(x: float, name: str = "") -> PosedView:
    """Return a camera at (x, 0, 0) that looks at (0, 0, 6)."""
    angle = np.arctan2(x, 6)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return PosedView(name, Camera(SIZE, 300.0), rotation, -rotation @ [x, 0, 0])


def test_neighbours_share_points_at_a_good_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense, "NEIGHBOURS", 2)
    views = {k: view(x, str(k)) for k, x in enumerate((0.0, 0.02, 0.6, 1.2, 9.0))}
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 5.5), (1, 1, 6.5), (200, 3))
    rows, numbers, xy = [], [], []
    for row, point in enumerate(points):
        for number, own in views.items():
            rows.append(row)
            numbers.append(number)
            xy.append(own.project(point[None])[0][0])
    seen = Observations(np.array(rows), np.array(numbers), np.array(xy), np.array(rows))
    intrinsics = {number: CameraIntrinsics.of_camera(own.camera) for number, own in views.items()}
    sparse = SparseModel(views, intrinsics, points, np.zeros(200), seen)
    found = {each.view.name: each for each in find_references(sparse)}
    assert {each.view.name for each in found["0"].neighbours} == {"2", "3"}
    first = found["0"].neighbours[0]
    np.testing.assert_allclose(first.points0, views[0].project(points)[0])
    np.testing.assert_allclose(first.points1, views[int(first.view.name)].project(points)[0])
    lonely = dataclasses.replace(sparse, seen=Observations(*(a[::5] for a in vars(seen).values())))
    assert find_references(lonely) == []


def test_a_smaller_view_sees_the_same_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    own = view(0.5)
    assert limited_view(own) is own
    monkeypatch.setattr(dense, "MAX_SIDE_PX", 160)
    small = limited_view(own)
    assert small.camera.size == (160, 120)
    points = np.array([[0.3, -0.2, 6.0]])
    expected = (own.project(points)[0] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(small.project(points)[0], expected)
