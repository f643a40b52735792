"""Models of pycolmap with synthetic cameras and points; the pipeline tests the mapping itself."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import Camera, Keypoints, NoDepthError
from deepdetect.geometry.camera import camera_spacing
from deepdetect.sfm import mapping
from deepdetect.sfm.colmap import CameraIntrinsics, write_database
from deepdetect.sfm.mapping import (
    adjust,
    map_globally,
    map_images,
    normalise_model,
    read_sparse_model,
    require_pinholes,
    verify_pairs,
)

PLACES = np.array([[0.0, 0, 0], [2, 0, 0], [4, 0.5, 0], [6, 0, 0.5]])


@pytest.fixture
def model(pycolmap):
    """A model of four cameras in a row, with exact points, in no special frame."""
    made = pycolmap.Reconstruction()
    camera = CameraIntrinsics.of_camera(Camera((640, 480), 500.0)).colmap_camera()
    camera.camera_id = 1
    made.add_camera_with_trivial_rig(camera)
    rng = np.random.default_rng(0)
    points = rng.uniform((-1, -2, 8), (7, 2, 12), (80, 3))
    for number, place in enumerate(PLACES, 1):
        # Rolled cameras: parallel ones do not tell the principal point from the direction.
        turn = pycolmap.Rotation3d(np.array([0.1, 0.25 - 0.1 * number, 0.4 * number]))
        pose = pycolmap.Rigid3d(turn, -turn.matrix() @ place)
        seen = points @ turn.matrix().T + pose.translation
        xy = seen[:, :2] / seen[:, 2:] * 500 + (320, 240)
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=xy, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, 5):
            track.add_element(number, row)
        made.add_point3D(point, track)
    return made


def test_cameras_and_points_are_in_our_convention(model) -> None:
    sparse = read_sparse_model(model)
    assert [view.name for view in sparse.views.values()] == [f"{k}.jpg" for k in range(1, 5)]
    assert sparse.views["1.jpg"].camera == Camera((640, 480), 500.0)
    np.testing.assert_allclose([view.centre for view in sparse.views.values()], PLACES, atol=1e-9)
    assert sparse.errors.max() < 1e-6  # with pixels off by a half it would be 0.7
    assert (sparse.tracks == 4).all()


def test_the_world_becomes_the_frame_of_one_camera(model) -> None:
    before = read_sparse_model(model)
    normalise_model(model)
    after = read_sparse_model(model)
    views = list(after.views.values())
    reference = min(views, key=lambda view: np.linalg.norm(view.centre))
    np.testing.assert_allclose(reference.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(reference.centre, 0, atol=1e-9)
    assert camera_spacing(np.array([view.centre for view in views])) == pytest.approx(1)
    assert after.errors.max() < 1e-6
    scale = camera_spacing(np.array([view.centre for view in before.views.values()]))
    distances = [np.linalg.norm(sparse.points[0] - sparse.points[1]) for sparse in (before, after)]
    assert distances[0] / distances[1] == pytest.approx(scale)


def test_the_principal_point_is_estimated_from_many_images_only(model, monkeypatch) -> None:
    camera = model.cameras[1]
    camera.params = np.array([500.0, 500.0, 312.0, 236.0])
    adjust(model, False)  # four images are fewer than eight
    centre = read_sparse_model(model).views["1.jpg"].camera.centre
    assert centre == (311.5, 235.5)
    monkeypatch.setattr(mapping, "MIN_VIEWS_OF_PRINCIPAL_POINT", 3)
    adjust(model, False)
    centre = read_sparse_model(model).views["1.jpg"].camera.centre
    assert centre == pytest.approx((319.5, 239.5), abs=0.1)


@pytest.fixture
def attempts(pycolmap, monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """The models of each call of COLMAP's mapper."""
    made = []
    original = pycolmap.incremental_mapping

    def counted(*arguments, **keywords):
        made.append(original(*arguments, **keywords))
        return made[-1]

    monkeypatch.setattr(pycolmap, "incremental_mapping", counted)
    return made


def write_scenes(path: Path, steps: dict[str, tuple[np.ndarray, int]]) -> None:
    """Write a database of cameras that pass random points, by name: step and number of cameras."""
    rng = np.random.default_rng(0)
    intrinsics = CameraIntrinsics.of_camera(Camera((640, 480), 500.0))
    images = {}
    matches = {}
    for scene, (step, count) in steps.items():
        points = rng.uniform((-5, -3, 7), (5, 3, 13), (400, 3))
        own: list[tuple[str, np.ndarray]] = []
        for number in range(count):
            seen = points - number * step
            xy = seen[:, :2] / seen[:, 2:] * 500 + (319.5, 239.5)
            inside = ((xy > 0) & (xy < (639, 479))).all(axis=1)
            own.append((f"{scene}{number}.jpg", np.flatnonzero(inside)))
            noisy = xy[inside] + rng.normal(0, 0.2, (inside.sum(), 2))
            noisy = noisy.clip(0, (639, 479))
            points_seen = Keypoints(noisy, np.ones(len(noisy)), (640, 480))
            images[own[-1][0]] = points_seen, intrinsics
        for (name0, rows0), (name1, rows1) in itertools.combinations(own, 2):
            rows = np.intersect1d(rows0, rows1, return_indices=True)[1:]
            matches[name0, name1] = np.column_stack(rows)
    write_database(path, images, matches)


AHEAD, ASIDE = np.array([0, 0, 0.4]), np.array([0.8, 0, 0])


def test_cameras_that_move_straight_ahead_are_mapped(attempts, tmp_path: Path) -> None:
    """COLMAP's defaults find no pair to begin with: the second attempt does."""
    write_scenes(tmp_path / "database.db", {"ahead": (AHEAD, 5)})
    verified = verify_pairs(tmp_path / "database.db")
    model, others = map_images(tmp_path / "database.db", tmp_path, verified, True)
    assert [len(models) for models in attempts] == [0, 1]
    views = read_sparse_model(model).views.values()
    assert (len(views), others) == (5, [])
    path = np.array([view.centre for view in sorted(views, key=lambda view: view.name)])
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    np.testing.assert_allclose(lengths, lengths.mean(), rtol=0.1)
    assert ((steps @ steps[0]) / (lengths * lengths[0]) > 0.99).all()


@pytest.fixture
def run_away(pycolmap, monkeypatch: pytest.MonkeyPatch):
    """Let the focal length run away in the first models that a mapper of COLMAP makes."""

    def patch(name: str, times: int) -> list[int]:
        original, calls = getattr(pycolmap, name), []

        def mapper(*arguments, **keywords):
            models = original(*arguments, **keywords)
            calls.append(len(models))
            if len(calls) <= times:
                models[0].cameras[1].params = np.array([20_000.0, 20_000, 320, 240])
            return models

        monkeypatch.setattr(pycolmap, name, mapper)
        return calls

    return patch


def test_a_model_whose_camera_ran_away_is_made_again(run_away, tmp_path: Path) -> None:
    calls = run_away("incremental_mapping", 1)
    write_scenes(tmp_path / "database.db", {"aside": (ASIDE, 4)})
    verified = verify_pairs(tmp_path / "database.db")
    model, _ = map_images(tmp_path / "database.db", tmp_path, verified, False)
    assert calls == [1, 1]
    views = read_sparse_model(model).views.values()
    assert all(view.camera.focal_px == pytest.approx((500, 500), rel=0.05) for view in views)


def test_two_images_with_a_wrong_focal_length_are_not_the_end(
    pycolmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, fixed = pycolmap.incremental_mapping, []

    def mapper(database, folder, space, how, **named):
        fixed.append(not how.ba_refine_focal_length)
        return original(database, folder, space, how, **named) if fixed[-1] else {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapper)
    write_scenes(tmp_path / "database.db", {"aside": (ASIDE, 4)})
    verified = verify_pairs(tmp_path / "database.db")
    model, _ = map_images(tmp_path / "database.db", tmp_path, verified, False)
    assert fixed == [False, False, True]
    views = read_sparse_model(model).views.values()
    assert len(views) == 4
    assert all(view.camera.focal_px == pytest.approx((500, 500), rel=0.001) for view in views)


@pytest.mark.parametrize(
    ("mapper", "name"),
    [(map_images, "incremental_mapping"), (map_globally, "global_mapping")],
)
def test_cameras_that_cannot_be_told_are_no_model(
    run_away, mapper, name: str, tmp_path: Path
) -> None:
    run_away(name, 2)
    write_scenes(tmp_path / "database.db", {"aside": (ASIDE, 4)})
    verified = verify_pairs(tmp_path / "database.db")
    others = (False,) if name == "global_mapping" else (verified, False)
    with pytest.raises(NoDepthError):
        mapper(tmp_path / "database.db", tmp_path, *others)


def test_a_known_camera_may_be_a_telescope(pycolmap, tmp_path: Path) -> None:
    """COLMAP takes a focal length of over ten times the longer side for one that ran away."""
    rng = np.random.default_rng(0)
    points, camera = rng.uniform(-1, 1, (300, 3)), Camera((640, 480), 7680.0)
    images, rows = {}, np.column_stack([np.arange(300)] * 2)
    for number in range(4):
        turned = points @ cv2.Rodrigues(np.array([0.02, 0.15, 0.01]) * number)[0].T
        xy = camera.project(turned + (0, 0, 60)) + rng.normal(0, 0.2, (300, 2))
        intrinsics = CameraIntrinsics.of_camera(camera)
        images[f"{number}.jpg"] = Keypoints(xy, np.ones(300), (640, 480)), intrinsics
    pairs = itertools.combinations(images, 2)
    write_database(tmp_path / "database.db", images, dict.fromkeys(pairs, rows))
    verified = verify_pairs(tmp_path / "database.db")
    model, _ = map_images(tmp_path / "database.db", tmp_path, verified, True)
    views = read_sparse_model(model).views.values()
    assert [view.camera.focal_px for view in views] == [(7680, 7680)] * 4


@pytest.mark.parametrize(("ahead", "calls"), [(5, 2), (3, 1)])
def test_a_drive_beside_a_smaller_scene(attempts, ahead: int, calls: int, tmp_path: Path) -> None:
    """A second attempt is made where more photographs are left than the first has mapped."""
    write_scenes(tmp_path / "database.db", {"ahead": (AHEAD, ahead), "aside": (ASIDE, 4)})
    verified = verify_pairs(tmp_path / "database.db")
    model, others = map_images(tmp_path / "database.db", tmp_path, verified, True)
    assert len(attempts) == calls
    aside = frozenset(f"aside{number}.jpg" for number in range(4))
    names = {view.name for view in read_sparse_model(model).views.values()}
    if calls == 1:
        assert (names, others) == (aside, [])
    else:
        assert names == {f"ahead{number}.jpg" for number in range(ahead)}
        assert others == [aside]


def test_all_poses_at_once_and_the_smaller_scene_apart(tmp_path: Path) -> None:
    write_scenes(tmp_path / "database.db", {"aside": (ASIDE, 6), "up": (ASIDE[[1, 0, 2]], 4)})
    verify_pairs(tmp_path / "database.db")
    model, others = map_globally(tmp_path / "database.db", tmp_path, True)
    views = sorted(read_sparse_model(model).views.values(), key=lambda view: view.name)
    assert [view.name for view in views] == [f"aside{number}.jpg" for number in range(6)]
    assert others == [frozenset(f"up{number}.jpg" for number in range(4))]
    steps = np.diff([view.centre for view in views], axis=0)
    np.testing.assert_allclose(steps, np.tile(steps.mean(axis=0), (5, 1)), atol=0.02)
    assert {view.camera.focal_px for view in views} == {(500, 500)}  # known, so it stays
    pointing = views[0].rotation @ (views[-1].centre - views[0].centre)
    np.testing.assert_allclose(pointing / np.linalg.norm(pointing), [1, 0, 0], atol=0.02)


def model_seen_by(pycolmap, lens: str, params: list[float], degrees: float):
    """A model of six images by a lens, with noise, bundle-adjusted as if by a pinhole."""
    rng = np.random.default_rng(0)
    camera = pycolmap.Camera(model=lens, width=640, height=480, params=params)
    made = pycolmap.Reconstruction()
    start = CameraIntrinsics("SIMPLE_RADIAL", (640, 480), (400.0, 320.0, 240.0, -0.1))
    assumed = start.colmap_camera()
    assumed.camera_id = 1
    made.add_camera_with_trivial_rig(assumed)
    points = rng.uniform((-6, -4, 1), (6, 4, 6), (600, 3))
    tracks: dict[int, list[tuple[int, int]]] = {}
    for number in range(1, 7):
        turn = pycolmap.Rotation3d(np.array([0.1, 0.3 - 0.1 * number, 0.3 * number]))
        place = np.array([0.5 * number - 1.5, 0.2 * (number % 3), -1.0])
        pose = pycolmap.Rigid3d(turn, -turn.matrix() @ place)
        seen = points @ turn.matrix().T + pose.translation
        rows = np.flatnonzero(
            seen[:, 2] > np.linalg.norm(seen, axis=1) * np.cos(np.radians(degrees))
        )
        xy = camera.img_from_cam(np.ascontiguousarray(seen[rows]))
        inside = ((xy > 0) & (xy < (640, 480))).all(axis=1)
        rows, xy = rows[inside], xy[inside] + rng.normal(0, 0.3, (inside.sum(), 2))
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=xy, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pose)
        for k, row in enumerate(rows):
            tracks.setdefault(int(row), []).append((number, k))
    for row, places in tracks.items():
        if len(places) > 2:
            track = pycolmap.Track()
            for number, k in places:
                track.add_element(number, k)
            made.add_point3D(points[row], track)
    adjust(made, known_cameras=False)
    return made


@pytest.mark.parametrize(
    ("lens", "params", "degrees"),
    [
        ("OPENCV_FISHEYE", [382.0, 382, 320, 240, 0, 0, 0, 0], 60),
        ("OPENCV_FISHEYE", [270.0, 270, 320, 240, 0, 0, 0, 0], 84),
        ("OPENCV_FISHEYE", [330.0, 330, 320, 240, -1 / 24, 1 / 1920, 0, 0], 72),  # equisolid
    ],
)
def test_a_fisheye_is_no_pinhole(pycolmap, lens, params, degrees) -> None:
    with pytest.raises(NoDepthError, match="fisheye"):
        require_pinholes(model_seen_by(pycolmap, lens, params, degrees))


@pytest.mark.parametrize(
    ("lens", "params", "degrees"),
    [
        ("SIMPLE_RADIAL", [400.0, 320, 240, -0.3], 44),
        ("SIMPLE_RADIAL", [340.0, 320, 240, -0.15], 55),
        ("SIMPLE_PINHOLE", [231.0, 320, 240], 70),
        ("OPENCV", [430.0, 430, 321, 242, -0.12, 0.09, 0.0003, 0.0003], 50),
        (
            "OPENCV",
            [390.0, 390, 313, 244, -0.283, 0.074, 0.0002, 0.00002],
            48,
        ),
    ],
)
def test_distorting_lenses_stay_pinholes(pycolmap, lens, params, degrees) -> None:
    made = model_seen_by(pycolmap, lens, params, degrees)
    before = [*made.cameras[1].params]
    require_pinholes(made)
    assert [*made.cameras[1].params] == before
    assert made.cameras[1].model_name == "SIMPLE_RADIAL"
