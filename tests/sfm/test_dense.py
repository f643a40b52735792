"""Which photographs are matched for dense points; their points are tested with the pipeline."""

from __future__ import annotations

import dataclasses

import numpy as np

from deepdetect.geometry.camera import Camera
from deepdetect.geometry.posed_view import PosedView
from deepdetect.sfm.dense import find_references, limited_view
from deepdetect.sfm.fusion import DenseOptions
from deepdetect.sfm.lens import Lens
from deepdetect.sfm.mapping import Observations, SparseModel

SIZE = (320, 240)


def view(x: float, name: str = "") -> PosedView:
    """Return a camera at (x, 0, 0) that looks at (0, 0, 6)."""
    angle = np.arctan2(x, 6)
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    return PosedView(name, Camera(SIZE, 300.0), rotation, -rotation @ [x, 0, 0])


def test_neighbours_share_points_at_a_good_angle() -> None:
    views = {k: view(x, str(k)) for k, x in enumerate((0.0, 0.02, 0.6, 1.2, 9.0))}
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -1, 5.5), (1, 1, 6.5), (200, 3))
    rows, numbers, xy = [], [], []
    for row, point in enumerate(points):
        for number, own in views.items():
            rows.append(row)
            numbers.append(number)
            xy.append(own.project(point[None])[0][0])
    seen = Observations(np.array(rows), np.array(numbers), np.array(xy))
    lenses = {number: Lens.of_camera(own.camera) for number, own in views.items()}
    sparse = SparseModel(views, lenses, points, np.zeros(200), seen)
    found = {each.view.name: each for each in find_references(sparse, DenseOptions(neighbours=2))}
    assert {each.view.name for each in found["0"].neighbours} == {"2", "3"}
    first = found["0"].neighbours[0]
    np.testing.assert_allclose(first.points0, views[0].project(points)[0])
    np.testing.assert_allclose(first.points1, views[int(first.view.name)].project(points)[0])
    lonely = dataclasses.replace(sparse, seen=Observations(*(a[::5] for a in vars(seen).values())))
    assert find_references(lonely) == []


def test_a_smaller_view_sees_the_same_directions() -> None:
    own = view(0.5)
    small = limited_view(own, DenseOptions(max_side_px=160))
    assert small.camera.size == (160, 120)
    points = np.array([[0.3, -0.2, 6.0]])
    expected = (own.project(points)[0] + 0.5) / 2 - 0.5
    np.testing.assert_allclose(small.project(points)[0], expected)
    assert limited_view(own, DenseOptions()) is own
