from __future__ import annotations

from math import erf

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.metrics.multi_view import (
    AGREEMENT_PX,
    PLANE_NEIGHBOURS,
    camera_errors,
    cloud_agreement,
    relative_pose_errors,
)
from deepdetect.geometry.camera import Camera
from deepdetect.geometry.posed_view import PosedView

CAMERA = Camera((400, 300), 600.0)
MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value, over the standard deviation."""


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


def noisy_plane(rng: np.random.Generator, noise: float, slope: float = 0.4) -> np.ndarray:
    """Points of a slanted plane with errors along the line of sight from the origin."""
    y, x = np.mgrid[-1:1:150j, -1:1:150j].reshape(2, -1)
    points = np.column_stack([x, y, 10 + slope * x])
    return points * (1 + noise * rng.normal(size=(len(points), 1)))


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_the_noise_of_two_planes_is_found(noise: float) -> None:
    """Also where it is larger than the spacing of the points, which is 1.3e-3 of the depth."""
    rng = np.random.default_rng(2)
    baseline = 1.5
    views = [posed("0", np.eye(3), np.zeros(3)), posed("1", np.eye(3), np.array([baseline, 0, 0]))]
    sets = noisy_plane(rng, noise), noisy_plane(rng, noise)
    found = cloud_agreement(*sets, views)
    assert found.covered == 1
    expected = MEDIAN_OF_NORMAL * noise * np.sqrt(1 + 1.3 / PLANE_NEIGHBOURS)
    assert found.median_depth_ratio == pytest.approx(expected, rel=0.1)
    # The second camera sees a relative change of depth as focal length * baseline / depth of it.
    px = expected * 600 * baseline / 10
    assert found.median_px == pytest.approx(px, rel=0.1)
    assert list(found.within) == sorted(found.within)
    limit = AGREEMENT_PX[0]
    share = erf(limit / (px / MEDIAN_OF_NORMAL) / np.sqrt(2))
    assert found.within[0] == pytest.approx(share, abs=0.02)


def test_what_only_one_set_has_is_not_covered() -> None:
    rng = np.random.default_rng(3)
    views = [posed("0", np.eye(3), np.zeros(3))]
    plane, other = noisy_plane(rng, 1e-4), noisy_plane(rng, 1e-4)
    wrong = plane[:1000] * 1.2  # gross errors
    found = cloud_agreement(np.concatenate([plane, wrong]), other[other[:, 0] < 0], views)
    assert found.points == len(plane) + 1000
    # Up to MAX_GAP_PX beyond the border there is something near.
    assert found.covered == pytest.approx(0.5 * len(plane) / found.points, abs=0.06)
    assert found.median_depth_ratio < 1e-3
    behind = cloud_agreement(plane * [1, 1, -1], other, views)
    assert behind.covered == 0
    assert np.isnan(behind.median_px)
    assert cloud_agreement(plane[:0], other, views).covered == 0
    assert cloud_agreement(plane, other[:3], views).covered == 0
