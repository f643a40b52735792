from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.relative_pose import (
    estimate_relative_pose,
    refine_pose,
    rotation_angle,
)

CAMERA0 = Camera((370, 250), 497, (155, 127))
CAMERA1 = Camera((370, 250), 497, (170, 127))
CALIBRATION = Calibration(CAMERA0, CAMERA1)
ROTATION = cv2.Rodrigues(np.radians([1.0, -3.0, 5.0]))[0]
TRANSLATION = np.array([-0.98, 0.1, 0.17]) / np.linalg.norm([-0.98, 0.1, 0.17])


def true_matches(noise: float, wrong: float, count: int = 8000) -> tuple[np.ndarray, np.ndarray]:
    """Matches of random points at depths of 4 to 15 baselines, some of them astray."""
    generator = np.random.default_rng(0)
    pixels = generator.uniform((0, 0), CAMERA0.size, (count, 2))
    points = CAMERA0.rays(pixels) * generator.uniform(4, 15, (count, 1))
    there = CAMERA1.project(points @ ROTATION.T + TRANSLATION)
    there += generator.normal(0, noise, there.shape)
    astray = generator.random(count) < wrong
    there[astray] = generator.uniform((0, 0), CAMERA1.size, (astray.sum(), 2))
    return pixels, there


def rotation_error(rotation: np.ndarray) -> float:
    return rotation_angle(rotation @ ROTATION.T)


def direction_error(translation: np.ndarray) -> float:
    across = np.linalg.norm(np.cross(translation, TRANSLATION))
    return float(np.degrees(np.arctan2(across, translation @ TRANSLATION)))


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 3.0, 90.0, 179.9])
def test_the_angle_of_a_rotation(degrees: float) -> None:
    axis = np.array([0.6, 0, 0.8])
    turn = cv2.Rodrigues(np.radians(degrees) * axis)[0]
    assert rotation_angle(turn) == pytest.approx(degrees, rel=1e-6, abs=1e-9)


def test_exact_matches_give_the_exact_pose() -> None:
    pose = estimate_relative_pose(*true_matches(0, 0), CALIBRATION)
    assert rotation_error(pose.rotation) < 0.01
    assert direction_error(pose.translation) < 0.1
    assert np.linalg.norm(pose.translation) == pytest.approx(1)
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert pose.cheirality_ratio == 1
    assert pose.inliers.all()


def test_refinement_makes_a_pose_from_noise_better() -> None:
    matches = true_matches(0.3, 0.3)
    fine = estimate_relative_pose(*matches, CALIBRATION)
    assert rotation_error(fine.rotation) < 0.05
    assert direction_error(fine.translation) < 0.5
    assert 0.68 < fine.inliers.mean() < 0.75
    assert fine.errors[fine.inliers].max() < 1 <= fine.errors[~fine.inliers].min()


def test_exact_matches_count_more_than_others() -> None:
    """Half of the matches are exact across one axis only; their covariances tell which."""
    points0, points1 = true_matches(0, 0, 400)
    covariances = np.tile(np.diag([0.09, 0.09]), (400, 1, 1))
    covariances[::2, 1, 1] = 0
    errors = []
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0, 0.3, points1.shape)
        noise[::2, 1] = 0
        for known in (None, covariances):
            pose = estimate_relative_pose(points0, points1 + noise, CALIBRATION, covariances=known)
            errors.append((rotation_error(pose.rotation), direction_error(pose.translation)))
    equal, weighted = np.reshape(errors, (5, 2, 2)).mean(axis=0)
    assert (weighted < 0.5 * equal).all()


def test_is_the_same_for_a_seed() -> None:
    matches = true_matches(0.3, 0.3)
    one, same, other = (
        estimate_relative_pose(*matches, CALIBRATION, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.rotation, same.rotation)
    np.testing.assert_array_equal(one.inliers, same.inliers)
    assert rotation_angle(one.rotation @ other.rotation.T) < 0.05


def test_refinement_never_makes_it_worse_and_leaves_the_best_alone() -> None:
    points0, points1 = true_matches(0, 0)
    rotation, translation = refine_pose(points0, points1, CALIBRATION, ROTATION, 5 * TRANSLATION)
    assert rotation_error(rotation) < 1e-3
    assert direction_error(translation) < 1e-2
    wrong = cv2.Rodrigues(np.array([0.01, -0.01, 0.01]))[0] @ ROTATION
    rotation, translation = refine_pose(
        points0, points1, CALIBRATION, wrong, TRANSLATION + [0, 0.05, 0.05]
    )
    assert rotation_error(rotation) < 1e-2
    assert direction_error(translation) < 0.1


def test_too_few_matches_give_none() -> None:
    camera = Camera((640, 480), 500)
    both = Calibration(camera, camera)
    points = np.random.default_rng(0).uniform(0, 400, (5, 2))
    assert estimate_relative_pose(points, points + 3, both) is None
    assert estimate_relative_pose(np.empty((0, 2)), np.empty((0, 2)), both) is None
    one_place = np.full((50, 2), 100.0)
    assert estimate_relative_pose(one_place, one_place, both) is None
