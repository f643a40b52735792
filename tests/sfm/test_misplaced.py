from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.sfm.mapping import map_images, read_sparse_model, verify_pairs
from deepdetect.sfm.misplaced import correct_places

STEP = np.array([0.5, 0, 0.4])


def centres(model) -> np.ndarray:
    views = sorted(read_sparse_model(model).views.values(), key=lambda view: view.name)
    return np.array([view.centre for view in views])


@pytest.fixture
def mapped(write_scenes, tmp_path: Path):
    """A model of seven cameras on a line, and its database."""
    database = tmp_path / "database.db"
    write_scenes(database, {"walk": (STEP, 7)})
    return map_images(database, tmp_path, verify_pairs(database), True)[0], database


def misplace(pycolmap, model, database: Path, name: str, turn_deg: float, move: float):
    """Turn and move an image by so many steps, and give it the points that agree with that."""
    image = next(image for image in model.images.values() if image.name == name)
    turn = pycolmap.Rotation3d(np.array([0, np.radians(turn_deg), 0]))
    step = np.linalg.norm(np.diff(centres(model), axis=0), axis=1).mean()
    pose = pycolmap.Rigid3d(turn, np.array([0, 0, move * step])) * image.cam_from_world()
    image.frame.set_cam_from_world(image.camera_id, pose)
    return pycolmap.triangulate_points(model, database, database.parent, database.parent)


@pytest.mark.parametrize(("turn_deg", "move"), [(0, 2.0), (8, 0.0), (3, -1.0)])
def test_images_in_a_wrong_place_are_put_in_the_right_one(
    pycolmap, mapped, turn_deg: float, move: float
) -> None:
    model, database = mapped
    wanted = centres(model)
    for name in ("walk0.jpg", "walk4.jpg"):
        model = misplace(pycolmap, model, database, name, turn_deg, move)
    step = np.linalg.norm(np.diff(wanted, axis=0), axis=1).mean()
    split = read_sparse_model(model).tracks.mean()
    model = correct_places(model, database, database.parent, True, 0)
    found = centres(model)
    steps = np.diff(found, axis=0) / np.linalg.norm(np.diff(found, axis=0), axis=1).mean()
    np.testing.assert_allclose(steps, np.diff(wanted, axis=0) / step, atol=0.05)
    sparse = read_sparse_model(model)
    assert sparse.tracks.mean() > split
    assert sparse.errors.max() < 4


def test_images_in_their_place_stay(pycolmap, mapped) -> None:
    model, database = mapped
    before = centres(model)
    assert correct_places(model, database, database.parent, True, 0) is model
    np.testing.assert_array_equal(centres(model), before)
