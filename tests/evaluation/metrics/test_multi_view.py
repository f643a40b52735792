from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.metrics.multi_view import (
    camera_errors,
    relative_pose_errors,
)
from deepdetect.geometry.camera import Camera, PosedView

CAMERA = Camera((400, 300), 600.0)


def turned(degrees: tuple[float, float, float]) -> np.ndarray:
    return cv2.Rodrigues(np.radians(np.array(degrees)))[0]


def posed(name: str, rotation: np.ndarray, centre: np.ndarray) -> PosedView:
    return PosedView(name, CAMERA, rotation, -rotation @ centre)


@pytest.fixture
def truth() -> dict[str, PosedView]:
    rng = np.random.default_rng(0)
    return {
        name: posed(name, turned(tuple(rng.uniform(-20, 20, 3))), rng.uniform(-2, 2, 3))
        for name in "abcdef"
    }


def in_another_frame(views: dict[str, PosedView], scale: float) -> dict[str, PosedView]:
    turn, shift = turned((30, -50, 10)), np.array([4.0, -2, 7])
    return {
        name: posed(name, view.rotation @ turn.T, scale * turn @ view.centre + shift)
        for name, view in views.items()
    }


def test_the_frame_and_the_unit_of_a_model_do_not_matter(truth: dict[str, PosedView]) -> None:
    own = in_another_frame(truth, 0.25)
    found = camera_errors(list(own.values()), list(truth.values()))
    np.testing.assert_allclose(found.centres, 0, atol=1e-9)
    np.testing.assert_allclose(found.rotations_deg, 0, atol=1e-5)
    assert found.scale == pytest.approx(4)
    np.testing.assert_allclose(relative_pose_errors(own, truth), 0, atol=1e-5)


def test_errors_of_cameras_have_the_size_that_they_were_given(truth) -> None:
    rng = np.random.default_rng(1)
    many = {
        f"{k}": posed(f"{k}", turned(tuple(rng.uniform(-20, 20, 3))), rng.uniform(-2, 2, 3))
        for k in range(200)
    }
    wrong = {
        name: posed(name, turned((0, 0, 0.5)) @ view.rotation, view.centre + rng.normal(0, 0.01, 3))
        for name, view in many.items()
    }
    own = in_another_frame(wrong, 3.0)
    found = camera_errors(list(own.values()), list(many.values()))
    # The mean length of a vector of three normal numbers is 1.596.
    assert found.centres.mean() == pytest.approx(0.01596, rel=0.1)
    np.testing.assert_allclose(found.rotations_deg, 0.5, atol=0.05)


def test_pairs_with_a_missing_camera_have_no_pose(truth: dict[str, PosedView]) -> None:
    views = {name: view for name, view in truth.items() if name != "c"}
    views["a"] = posed("a", turned((0, 3, 0)) @ truth["a"].rotation, truth["a"].centre)
    errors = relative_pose_errors(views, truth)
    assert len(errors) == 15
    assert np.isinf(errors).sum() == 5
    finite = np.array(errors)[np.isfinite(errors)]
    assert (np.abs(finite - 3) < 1e-5).sum() == 4  # those with a
    assert (finite < 1e-5).sum() == 6
