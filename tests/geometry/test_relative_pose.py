from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.relative_pose import (
    estimate_relative_pose,
    refine_pose,
    rotation_angle,
)


def true_matches(turned: Any, noise: float, wrong: float) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    pixels = np.indices((370, 250)).reshape(2, -1).T[::7].astype(np.float64)
    there = turned.match(pixels)
    known = np.isfinite(there).all(1)
    pixels, there = pixels[known], there[known] + generator.normal(0, noise, (known.sum(), 2))
    astray = generator.random(len(there)) < wrong
    there[astray] = generator.uniform((0, 0), (370, 250), (astray.sum(), 2))
    return pixels, there


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 3.0, 90.0, 179.9])
def test_the_angle_of_a_rotation(degrees: float) -> None:
    axis = np.array([0.6, 0, 0.8])
    turn = cv2.Rodrigues(np.radians(degrees) * axis)[0]
    assert rotation_angle(turn) == pytest.approx(degrees, rel=1e-6, abs=1e-9)


def test_exact_matches_give_the_exact_pose(turned: Any) -> None:
    pose = estimate_relative_pose(*true_matches(turned, 0, 0), turned.calibration)
    assert turned.rotation_error(pose.rotation) < 0.01
    assert turned.direction_error(pose.translation) < 0.1
    assert np.linalg.norm(pose.translation) == pytest.approx(1)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert pose.cheirality_ratio == 1
    assert pose.inliers.all()


def test_refinement_makes_a_pose_from_noise_better(turned: Any) -> None:
    matches = true_matches(turned, 0.3, 0.3)
    rough, fine = (
        estimate_relative_pose(*matches, turned.calibration, refine=refine)
        for refine in (False, True)
    )
    assert turned.rotation_error(fine.rotation) < 0.05
    assert turned.rotation_error(fine.rotation) < 0.5 * turned.rotation_error(rough.rotation)
    assert turned.direction_error(fine.translation) < 0.5
    assert 0.68 < fine.inliers.mean() < 0.75
    assert fine.errors[fine.inliers].max() < 1 <= fine.errors[~fine.inliers].min()


def test_real_matches_give_the_pose(
    turned: Any, turned_matches: tuple[np.ndarray, np.ndarray]
) -> None:
    """Whole pixels: the refined matches of test_two_view give it several times better."""
    pose = estimate_relative_pose(*turned_matches, turned.calibration)
    assert turned.rotation_error(pose.rotation) < 0.5
    assert turned.direction_error(pose.translation) < 3
    assert pose.cheirality_ratio > 0.95


def test_is_the_same_for_a_seed(turned: Any) -> None:
    matches = true_matches(turned, 0.3, 0.3)
    one, same, other = (
        estimate_relative_pose(*matches, turned.calibration, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.rotation, same.rotation)
    np.testing.assert_array_equal(one.inliers, same.inliers)
    assert rotation_angle(one.rotation @ other.rotation.T) < 0.05


def test_refinement_never_makes_it_worse_and_leaves_the_best_alone(turned: Any) -> None:
    points0, points1 = true_matches(turned, 0, 0)
    rotation, translation = refine_pose(
        points0, points1, turned.calibration, turned.rotation, 5 * turned.translation
    )
    assert turned.rotation_error(rotation) < 1e-3
    assert turned.direction_error(translation) < 1e-2
    wrong = cv2.Rodrigues(np.array([0.01, -0.01, 0.01]))[0] @ turned.rotation
    rotation, translation = refine_pose(
        points0, points1, turned.calibration, wrong, turned.translation + [0, 0.05, 0.05]
    )
    assert turned.rotation_error(rotation) < 1e-2
    assert turned.direction_error(translation) < 0.1


def test_too_few_matches_give_none() -> None:
    camera = Camera((640, 480), 500)
    both = Calibration(camera, camera)
    points = np.random.default_rng(0).uniform(0, 400, (5, 2))
    assert estimate_relative_pose(points, points + 3, both) is None
    assert estimate_relative_pose(np.empty((0, 2)), np.empty((0, 2)), both) is None
    one_place = np.full((50, 2), 100.0)
    assert estimate_relative_pose(one_place, one_place, both) is None
