from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.camera import Camera, PosedView
from deepdetect_lab.evaluation.metrics.pose import (
    camera_errors,
    epipolar_inlier_ratio,
    relative_pose_errors,
    rotation_error,
    translation_error,
)


@pytest.mark.parametrize("degrees", [0, 1e-4, 0.5, 30, 90, 179, 180])
def test_rotations_differ_by_the_angle_that_was_turned(degrees: float) -> None:
    rng = np.random.default_rng(0)
    true = cv2.Rodrigues(rng.normal(size=3))[0]
    axis = rng.normal(size=3)
    turn = cv2.Rodrigues(np.radians(degrees) * axis / np.linalg.norm(axis))[0]
    assert rotation_error(turn @ true, true) == pytest.approx(degrees, abs=1e-6)
    assert rotation_error(true, turn @ true) == pytest.approx(degrees, abs=1e-6)


@pytest.mark.parametrize("degrees", [0, 1e-4, 45, 135, 180])
def test_translations_differ_by_their_angle_whatever_their_lengths(degrees: float) -> None:
    angle = np.radians(degrees)
    estimated = 0.1 * np.array([np.cos(angle), 0, np.sin(angle)])
    assert translation_error(estimated, np.array([7.0, 0, 0])) == pytest.approx(degrees, abs=1e-9)


def test_without_a_true_translation_there_is_no_error_of_its_direction() -> None:
    assert translation_error(np.array([0, 0, 1.0]), np.zeros(3)) == 0


def test_agreement_is_sampsons_distance() -> None:
    """A camera moves to the right, so lines are rows: both points share the shift across them."""
    rows = np.array([[0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    points = np.full((4, 2), 9.0)
    moved = points + [[5, 0], [-7, 1.41], [0, 1.42], [3, -2]]
    assert epipolar_inlier_ratio(points, moved, rows) == 0.5
    assert epipolar_inlier_ratio(points[:0], moved[:0], rows) == 0


CAMERA = Camera((400, 300), 600.0)


def turned(degrees: tuple[float, float, float]) -> np.ndarray:
    return cv2.Rodrigues(np.radians(np.array(degrees)))[0]


def posed(name: str, rotation: np.ndarray, centre: np.ndarray) -> PosedView:
    return PosedView(name, CAMERA, rotation, -rotation @ centre)


def cameras(count: int) -> dict[str, PosedView]:
    rng = np.random.default_rng(0)
    return {
        f"{k}": posed(f"{k}", turned(tuple(rng.uniform(-20, 20, 3))), rng.uniform(-2, 2, 3))
        for k in range(count)
    }


def in_another_frame(views: dict[str, PosedView], scale: float) -> dict[str, PosedView]:
    turn, shift = turned((30, -50, 10)), np.array([4.0, -2, 7])
    return {
        name: posed(name, view.rotation @ turn.T, scale * turn @ view.centre + shift)
        for name, view in views.items()
    }


def test_the_frame_and_the_unit_of_a_model_do_not_matter() -> None:
    truth = cameras(6)
    own = in_another_frame(truth, 0.25)
    centres, rotations, scale = camera_errors(list(own.values()), list(truth.values()))
    np.testing.assert_allclose(centres, 0, atol=1e-9)
    np.testing.assert_allclose(rotations, 0, atol=1e-5)
    assert scale == pytest.approx(4)
    np.testing.assert_allclose(relative_pose_errors(own, truth), 0, atol=1e-5)


def test_errors_of_cameras_have_the_size_that_they_were_given() -> None:
    rng = np.random.default_rng(1)
    many = cameras(200)
    wrong = {
        name: posed(name, turned((0, 0, 0.5)) @ view.rotation, view.centre + rng.normal(0, 0.01, 3))
        for name, view in many.items()
    }
    own = in_another_frame(wrong, 3.0)
    centres, rotations, _ = camera_errors(list(own.values()), list(many.values()))
    # The mean length of a vector of three normal numbers is 1.596.
    assert centres.mean() == pytest.approx(0.01596, rel=0.1)
    np.testing.assert_allclose(rotations, 0.5, atol=0.05)


def test_cameras_on_a_line_have_no_rotations() -> None:
    rng = np.random.default_rng(2)
    drive = {
        f"{k}": posed(f"{k}", turned((0, 0.1 * k, 0)), np.array([0.02 * rng.normal(), 0, k]))
        for k in range(20)
    }
    own = in_another_frame(drive, 0.5)
    centres, rotations, _ = camera_errors(list(own.values()), list(drive.values()))
    np.testing.assert_allclose(centres, 0, atol=1e-9)
    assert np.isnan(rotations).all()


def test_pairs_with_a_missing_camera_have_no_pose() -> None:
    truth = cameras(6)
    views = {name: view for name, view in truth.items() if name != "2"}
    views["0"] = posed("0", turned((0, 3, 0)) @ truth["0"].rotation, truth["0"].centre)
    errors = relative_pose_errors(views, truth)
    assert len(errors) == 15
    assert np.isinf(errors).sum() == 5
    finite = np.array(errors)[np.isfinite(errors)]
    assert (np.abs(finite - 3) < 1e-5).sum() == 4  # those with the first
    assert (finite < 1e-5).sum() == 6
