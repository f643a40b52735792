from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import Calibration, Camera, Keypoints, PointDetector, ReconstructionError
from deepdetect.sfm.colmap import (
    CameraIntrinsics,
    initial_intrinsics,
    known_cameras,
    quiet_pycolmap,
    sift_bytes,
    write_database,
)

SIZES = {"a.jpg": (640, 480), "b.jpg": (640, 480), "c.jpg": (320, 240)}


def test_what_pycolmap_logs_is_not_seen(pycolmap, capfd: pytest.CaptureFixture[str]) -> None:
    pycolmap.logging.warning("loud")
    assert "loud" in capfd.readouterr().err
    with quiet_pycolmap() as found:
        assert found is pycolmap
        found.logging.warning("quiet")
    pycolmap.logging.warning("loud again")
    shown = capfd.readouterr().err
    assert "quiet" not in shown
    assert "loud again" in shown


def test_after_an_error_it_logs_again(pycolmap) -> None:
    before = pycolmap.logging.minloglevel
    with pytest.raises(ZeroDivisionError), quiet_pycolmap():
        raise ZeroDivisionError
    assert pycolmap.logging.minloglevel == before


def write(folder: Path, name: str, focal_35mm: int | None) -> None:
    exif = Image.Exif()
    if focal_35mm is not None:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", SIZES[name]).save(folder / name, exif=exif)


def test_images_of_one_size_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    for name in SIZES:
        write(tmp_path, name, 28)
    found = initial_intrinsics(tmp_path, SIZES)
    assert found["a.jpg"] is found["b.jpg"]
    assert found["c.jpg"] is not found["a.jpg"]
    assert {own.source for own in found.values()} == {"EXIF"}
    expected = 28 * np.hypot(640, 480) / np.hypot(36, 24)
    assert found["a.jpg"].params[0] == pytest.approx(expected)
    write(tmp_path, "b.jpg", 50)
    zoomed = initial_intrinsics(tmp_path, SIZES)
    assert zoomed["a.jpg"] is not zoomed["b.jpg"]
    assert zoomed["b.jpg"].params[0] > zoomed["a.jpg"].params[0]
    one = initial_intrinsics(tmp_path, SIZES, single_camera=True)
    assert one["a.jpg"] is one["b.jpg"]
    write(tmp_path, "a.jpg", None)  # what another image tells of the camera is taken
    one = initial_intrinsics(tmp_path, SIZES, single_camera=True)
    assert one["a.jpg"] is one["b.jpg"] == zoomed["b.jpg"]
    each = initial_intrinsics(tmp_path, SIZES, single_camera=False)
    assert len({id(own) for own in each.values()}) == 3


def test_without_exif_the_focal_length_is_given_or_guessed(tmp_path: Path) -> None:
    write(tmp_path, "a.jpg", None)
    one = {"a.jpg": SIZES["a.jpg"]}
    (guessed,) = initial_intrinsics(tmp_path, one).values()
    assert (guessed.source, guessed.params[0]) == ("estimated", 1.2 * 640)
    (given,) = initial_intrinsics(tmp_path, one, focal_px=555.0).values()
    assert (given.source, given.params[0]) == ("focal_px", 555.0)
    with pytest.raises(ReconstructionError):
        initial_intrinsics(tmp_path, one, focal_px=-3.0)


def test_a_calibration_is_for_one_size(tmp_path: Path) -> None:
    camera = Camera((640, 480), 500.0)
    for calibration in (camera, Calibration(camera, camera)):
        known = known_cameras(calibration, SIZES)
        assert known == {"a.jpg": camera, "b.jpg": camera}
    found = initial_intrinsics(tmp_path, SIZES, known)
    assert found["a.jpg"] is found["b.jpg"]
    assert found["a.jpg"].source == "given"
    with pytest.raises(ReconstructionError, match="640x480"):
        known_cameras(camera, {"c.jpg": SIZES["c.jpg"]})


def test_a_known_camera_keeps_its_numbers(pycolmap) -> None:
    camera = Camera((640, 480), (500.0, 510.0), (310.0, 250.0))
    own = CameraIntrinsics.of_camera(camera)
    assert own.pinhole == camera
    assert not own.distorts
    theirs = own.colmap_camera()
    # COLMAP's centre of the first pixel is (0.5, 0.5).
    assert (theirs.principal_point_x, theirs.principal_point_y) == (310.5, 250.5)
    assert theirs.has_prior_focal_length
    xy = np.array([[3.0, 4.0]])
    np.testing.assert_array_equal(own.from_pinhole(own.to_pinhole(xy)), xy)


def test_distortion_goes_there_and_back(pycolmap) -> None:
    own = CameraIntrinsics("SIMPLE_RADIAL", (640, 480), (500.0, 320.0, 240.0, -0.1))
    xy = np.random.default_rng(0).uniform((0, 0), (639, 479), (50, 2))
    straight = own.to_pinhole(xy)
    np.testing.assert_allclose(own.from_pinhole(straight), xy, atol=1e-6)
    # By the formula: x_distorted = x (1 + k r^2), in focal lengths from the centre.
    rays = (straight - np.array(own.pinhole.centre)) / 500
    bent = rays * (1 - 0.1 * (rays**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(bent * 500 + np.array(own.pinhole.centre), xy, atol=1e-6)


def test_a_straight_image_has_straight_lines(pycolmap) -> None:
    own = CameraIntrinsics("SIMPLE_RADIAL", (320, 240), (250.0, 160.0, 120.0, -0.15))
    y, x = np.indices((240, 320))
    straight = own.to_pinhole(np.column_stack([x.ravel(), y.ravel()]))
    # An image whose values are the straight columns of what it shows.
    picture = straight[:, 0].reshape(240, 320).astype(np.float32)
    found = own.undistort(picture)
    inside = (slice(30, -30), slice(30, -30))
    np.testing.assert_allclose(found[inside], x[inside], atol=0.1)
    assert np.abs(picture[inside] - x[inside]).max() > 2


def test_a_guess_is_marked_as_such(pycolmap) -> None:
    assert not CameraIntrinsics.initial((1000, 500)).colmap_camera().has_prior_focal_length
    assert CameraIntrinsics.initial((1000, 500), 900.0).colmap_camera().has_prior_focal_length


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV"])
def test_cameras_of_colmap_come_back(pycolmap, model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 400.0, 320, 240)
    own = CameraIntrinsics.of_colmap(camera)
    assert list(own.colmap_camera().params) == list(camera.params)
    assert own.pinhole == Camera((320, 240), 400.0)


def test_colmap_reads_what_is_written(pycolmap, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shared = CameraIntrinsics.of_camera(Camera((640, 480), 500.0))
    own = CameraIntrinsics.initial((320, 240))
    names = ["a b.jpg", "sub/ü.jpg", "c.jpg"]
    images = {
        name: (Keypoints(rng.uniform(0, 200, (20, 2)), np.ones(20), camera.size), camera)
        for name, camera in zip(names, (shared, shared, own), strict=True)
    }
    rows = np.array([[0, 3], [5, 1]])
    write_database(tmp_path / "d.db", images, {("c.jpg", "a b.jpg"): rows})
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        found = {image.name: image for image in database.read_all_images()}
        assert set(found) == set(names)
        assert database.num_cameras() == 2
        assert database.num_frames() == 3
        assert found["a b.jpg"].camera_id == found["sub/ü.jpg"].camera_id
        assert found["a b.jpg"].camera_id != found["c.jpg"].camera_id
        keypoints = database.read_keypoints(found["a b.jpg"].image_id)
        np.testing.assert_allclose(keypoints[:, :2], images["a b.jpg"][0].xy + 0.5, atol=1e-5)
        matches = database.read_matches(found["c.jpg"].image_id, found["a b.jpg"].image_id)
        np.testing.assert_array_equal(matches, rows)


def test_learned_descriptors_keep_their_neighbours_as_bytes(photo: np.ndarray) -> None:
    first, second = (PointDetector(300).extract(image) for image in (photo, photo[5:, 9:] // 2))
    expected = first.descriptors @ second.descriptors.T
    described = [sift_bytes(each) for each in (first, second)]
    assert {(each.shape, each.dtype.name) for each in described} == {((300, 128), "uint8")}
    for each, points in zip(described, (first, second), strict=True):
        cut = np.minimum(512 * np.abs(points.descriptors), 255)  # few are
        assert np.mean(cut == 255) < 0.001
        lengths = np.linalg.norm(each.astype(float), axis=1)
        np.testing.assert_allclose(lengths, np.linalg.norm(cut, axis=1), rtol=0.02)
    products = described[0].astype(int) @ described[1].astype(int).T
    near = expected.max(1) > 0.8  # others have no partner
    assert near.sum() > 100
    assert np.mean((products.argmax(1) == expected.argmax(1))[near]) > 0.98
