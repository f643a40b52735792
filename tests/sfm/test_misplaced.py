"""Models in which images were put in a wrong place, with the points that agree with it."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from deepdetect import Camera, Keypoints, PointDetector, reconstruct_many
from deepdetect.sfm import MultiViewOptions, stages
from deepdetect.sfm.colmap import CameraIntrinsics, write_database
from deepdetect.sfm.mapping import map_images, read_sparse_model, verify_pairs
from deepdetect.sfm.misplaced import correct_places

SIZE, FOCAL_PX = (640, 480), 500.0
STEP = np.array([0.5, 0, 0.4])
POINTS = np.random.default_rng(0).uniform((-5, -3, 9), (8, 3, 15), (600, 3))


@pytest.fixture(autouse=True)
def _pycolmap(pycolmap) -> None:
    pass


def centres(model) -> np.ndarray:
    views = sorted(read_sparse_model(model).views.values(), key=lambda view: view.name)
    return np.array([view.centre for view in views])


def write_walk(
    path: Path, places: np.ndarray, seen: np.ndarray | None = None, known: bool = True
) -> None:
    """Write a database of cameras that look ahead; of each, which points (N, P) it has seen."""
    rng = np.random.default_rng(1)
    intrinsics = CameraIntrinsics.of_camera(Camera(SIZE, FOCAL_PX))
    if not known:
        intrinsics = CameraIntrinsics.initial(SIZE, FOCAL_PX)
    seen = np.ones((len(places), len(POINTS)), bool) if seen is None else seen
    images, rows_of = {}, {}
    for number, place in enumerate(places):
        local = POINTS - place
        xy = local[:, :2] / local[:, 2:] * FOCAL_PX + np.array(SIZE) / 2 - 0.5
        inside = seen[number] & ((xy > 0) & (xy < np.array(SIZE) - 1)).all(axis=1)
        name = f"{number:02d}.jpg"
        rows_of[name] = np.flatnonzero(inside)
        xy = xy[inside] + rng.normal(0, 0.2, (inside.sum(), 2))
        images[name] = Keypoints(xy, np.ones(len(xy)), SIZE), intrinsics
    matches = {
        (a, b): np.column_stack(np.intersect1d(rows_of[a], rows_of[b], return_indices=True)[1:])
        for a, b in itertools.combinations(rows_of, 2)
    }
    write_database(path, images, matches)


def mapped(folder: Path, places: np.ndarray, **how):
    """Return the model of a walk, and its database."""
    database = folder / "database.db"
    write_walk(database, places, **how)
    known = how.get("known", True)
    return map_images(database, folder, verify_pairs(database), known)[0], database


def misplace(pycolmap, model, database: Path, numbers, turn_deg: float, move):
    """Turn images and move them (in steps of the walk), and give them points that agree."""
    step = np.median(np.linalg.norm(np.diff(centres(model), axis=0), axis=1))
    for image in model.images.values():
        if int(image.name.removesuffix(".jpg")) in numbers:
            turn = pycolmap.Rotation3d(np.array([0, np.radians(turn_deg), 0]))
            pose = pycolmap.Rigid3d(turn, -step * np.array(move)) * image.cam_from_world()
            image.frame.set_cam_from_world(image.camera_id, pose)
    return pycolmap.triangulate_points(model, database, database.parent, database.parent)


def assert_walk(model, places: np.ndarray) -> None:
    """Assert that all ways from image to image are those wanted, up to the frame and unit."""
    found = np.linalg.norm(centres(model)[:, None] - centres(model), axis=2)
    wanted = np.linalg.norm(places[:, None] - places, axis=2)
    np.testing.assert_allclose(found / found.mean(), wanted / wanted.mean(), atol=0.03)


WALK = np.arange(7)[:, None] * STEP


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("turn_deg", "move"), [(0, (0, 0, -2.0)), (8, (0, 0, 0)), (3, (0.5, 0, 1.0))]
)
def test_images_in_a_wrong_place_are_put_in_the_right_one(
    pycolmap, tmp_path: Path, turn_deg: float, move, known: bool
) -> None:
    model, database = mapped(tmp_path, WALK, known=known)
    model = misplace(pycolmap, model, database, (0, 4), turn_deg, move)
    split = read_sparse_model(model).tracks.mean()
    model = correct_places(model, database, tmp_path, known)
    assert_walk(model, WALK)
    sparse = read_sparse_model(model)
    assert sparse.tracks.mean() > split
    assert sparse.errors.max() < 4


def test_one_right_image_helps_the_next(pycolmap, tmp_path: Path) -> None:
    """Eight of ten are wrong: not all of them are seen at once."""
    places = np.arange(10)[:, None] * STEP
    model, database = mapped(tmp_path, places)
    rng = np.random.default_rng(1)
    for number in (0, 1, 2, 4, 5, 6, 8, 9):
        turn_deg, move = rng.normal(0, 5), rng.normal(0, 1, 3)
        model = misplace(pycolmap, model, database, (number,), turn_deg, move)
    assert_walk(correct_places(model, database, tmp_path, True), places)


def test_an_image_is_no_witness_of_its_own_place(pycolmap, tmp_path: Path) -> None:
    """Points that two images beside each other see have the depth that a third one gave them."""
    places = np.array([[x, 0, 0] for x in (0, 1, 1.02, 2, 3, 4, 5)])
    seen = np.zeros((7, len(POINTS)), bool)
    seen[:, :300] = True
    seen[:3, 300:] = True
    model, database = mapped(tmp_path, places, seen=seen)
    model = misplace(pycolmap, model, database, (0,), 0, (-0.6, 0, 0))
    assert_walk(correct_places(model, database, tmp_path, True), places)


@pytest.mark.parametrize(("here", "stays"), [(100, True), (60, False)])
def test_one_of_two_likely_places_is_kept(pycolmap, tmp_path: Path, here: int, stays: bool) -> None:
    """What image 3 shows of 120 points was seen from its place, of others from farther back."""
    local = POINTS - WALK[3]
    inside = (np.abs(local[:, :2] / local[:, 2:]) < (0.4, 0.3)).all(axis=1)
    rows = np.flatnonzero(inside)[: here + 120]
    assert len(rows) == here + 120
    places, seen = np.repeat(WALK[:, None], len(POINTS), axis=1), np.ones((7, len(POINTS)), bool)
    back = np.array([0, 0, -2 * np.linalg.norm(STEP)])
    places[3, rows[120:]] += back
    seen[3] = False
    seen[3, rows] = True
    model, database = mapped(tmp_path, places, seen=seen)
    assert_walk(model, WALK)
    model = misplace(pycolmap, model, database, (3,), 0, (0, 0, -2.0))
    moved = WALK + back * (np.arange(7) == 3)[:, None]
    assert_walk(model, moved)
    assert_walk(correct_places(model, database, tmp_path, True), moved if stays else WALK)


def test_images_in_their_place_stay(tmp_path: Path) -> None:
    model, database = mapped(tmp_path, WALK)
    before = centres(model)
    assert correct_places(model, database, tmp_path, True) is model
    np.testing.assert_array_equal(centres(model), before)


def test_a_model_is_not_given_up_for_one_without_points(pycolmap, tmp_path: Path) -> None:
    """COLMAP triangulates nothing of cameras with such a distortion."""
    model, database = mapped(tmp_path, WALK, known=False)
    model = misplace(pycolmap, model, database, (4,), 0, (0, 0, -2.0))
    count = len(model.points3D)
    for camera in model.cameras.values():
        camera.params = np.array([500, 320, 240, 1.5])
    assert len(correct_places(model, database, tmp_path, False).points3D) == count


@pytest.mark.parametrize(
    ("mapper", "name"), [("incremental", "map_images"), ("global", "map_globally")]
)
def test_many_images_are_reconstructed_so(
    pycolmap,
    write_fountain,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mapper: str,
    name: str,
) -> None:
    folder, original = write_fountain(tmp_path / "photos"), getattr(stages, name)
    right = []

    def misplaced(database, *arguments):
        model, others = original(database, *arguments)
        right.append(centres(model))
        names = {image.name: number for number, image in enumerate(model.images.values())}
        assert len(names) == 4
        return misplace(pycolmap, model, database, (5,), 15, (1.5, 0, 0)), others

    monkeypatch.setattr(stages, name, misplaced)
    how = MultiViewOptions(dense=False, mapper=mapper)
    found = reconstruct_many(
        folder, tmp_path / "model", PointDetector(1000), options=how, workers=1
    )
    assert len(found.views) == 4
    places = np.array([found.views[name].centre for name in sorted(found.views)])
    wanted = np.linalg.norm(right[0][:, None] - right[0], axis=2)
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    np.testing.assert_allclose(distances / distances.mean(), wanted / wanted.mean(), atol=0.05)
