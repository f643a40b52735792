from __future__ import annotations

import numpy as np
import pytest

from deepdetect.geometry.camera import Camera
from deepdetect.sfm.lens import Lens


def test_a_known_camera_keeps_its_numbers(pycolmap) -> None:
    camera = Camera((640, 480), (500.0, 510.0), (310.0, 250.0))
    lens = Lens.of_camera(camera)
    assert lens.pinhole == camera
    assert not lens.distorts
    theirs = lens.colmap_camera()
    # COLMAP's centre of the first pixel is (0.5, 0.5).
    assert (theirs.principal_point_x, theirs.principal_point_y) == (310.5, 250.5)
    assert theirs.has_prior_focal_length
    xy = np.array([[3.0, 4.0]])
    assert lens.to_pinhole(xy) is not None
    np.testing.assert_array_equal(lens.from_pinhole(lens.to_pinhole(xy)), xy)


def test_distortion_goes_there_and_back(pycolmap) -> None:
    lens = Lens("SIMPLE_RADIAL", (640, 480), (500.0, 320.0, 240.0, -0.1))
    xy = np.random.default_rng(0).uniform((0, 0), (639, 479), (50, 2))
    straight = lens.to_pinhole(xy)
    np.testing.assert_allclose(lens.from_pinhole(straight), xy, atol=1e-6)
    # By the formula: x_distorted = x (1 + k r^2), in focal lengths from the centre.
    rays = (straight - np.array(lens.pinhole.centre)) / 500
    bent = rays * (1 - 0.1 * (rays**2).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(bent * 500 + np.array(lens.pinhole.centre), xy, atol=1e-6)


def test_a_straight_photograph_has_straight_lines(pycolmap) -> None:
    lens = Lens("SIMPLE_RADIAL", (320, 240), (250.0, 160.0, 120.0, -0.15))
    y, x = np.indices((240, 320))
    straight = lens.to_pinhole(np.column_stack([x.ravel(), y.ravel()]))
    # A photograph whose values are the straight columns of what it shows.
    picture = straight[:, 0].reshape(240, 320).astype(np.float32)
    found = lens.undistort(picture)
    inside = (slice(30, -30), slice(30, -30))
    np.testing.assert_allclose(found[inside], x[inside], atol=0.1)
    assert np.abs(picture[inside] - x[inside]).max() > 2


def test_a_guess_is_marked_as_such(pycolmap) -> None:
    assert not Lens.initial((1000, 500)).colmap_camera().has_prior_focal_length
    assert Lens.initial((1000, 500), 900.0).colmap_camera().has_prior_focal_length


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV"])
def test_cameras_of_colmap_come_back(pycolmap, model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 400.0, 320, 240)
    lens = Lens.of_colmap(camera)
    assert list(lens.colmap_camera().params) == list(camera.params)
    assert lens.pinhole == Camera((320, 240), 400.0)
