from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.geometry import epipolar_errors, relative_pose
from deepdetect.geometry.camera import Calibration, Camera, fundamental_matrix
from deepdetect.geometry.relative_pose import correct_matches, triangulate

CAMERA0 = Camera((640, 480), (600, 610), (310, 250))
CAMERA1 = Camera((800, 600), (700, 690), (420, 290))
BOTH = Calibration(CAMERA0, CAMERA1)


def scene(
    angles: tuple[float, float, float] = (3, -5, 2),
    translation: tuple[float, float, float] = (-1, 0.2, 0.1),
    count: int = 300,
    far: float = 12,
) -> tuple[np.ndarray, ...]:
    """Points before both cameras, where they are seen, and the pose."""
    generator = np.random.default_rng(0)
    rotation = cv2.Rodrigues(np.radians(np.array(angles)))[0]
    moved = np.array(translation, np.float64)
    depth = generator.uniform(4, far, count)
    points = CAMERA0.rays(generator.uniform((0, 0), CAMERA0.size, (count, 2))) * depth[:, None]
    seen0, seen1 = CAMERA0.project(points), CAMERA1.project(points @ rotation.T + moved)
    return points, seen0, seen1, rotation, moved


def by_opencv(
    points0: np.ndarray, points1: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    first = CAMERA0.matrix @ np.eye(3, 4)
    second = CAMERA1.matrix @ np.column_stack([rotation, translation])
    found = cv2.triangulatePoints(first, second, points0.T.copy(), points1.T.copy())
    return (found[:3] / found[3]).T


@given(
    angles=st.tuples(*[st.floats(-8, 8)] * 3),
    direction=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.5, 0.5)),
)
def test_is_exact_without_noise(
    angles: tuple[float, float, float], direction: tuple[float, float, float]
) -> None:
    if np.linalg.norm(direction[:2]) < 0.05:
        direction = (1, 0, 0)
    points, seen0, seen1, *pose = scene(angles, direction)
    before = (points @ pose[0].T + pose[1])[:, 2] > 0.5
    found = triangulate(seen0, seen1, BOTH, *pose)
    wide = before & (found.triangulation_angle > np.radians(0.05))
    np.testing.assert_allclose(found.points[wide], points[wide], rtol=1e-5, atol=1e-5)
    assert found.cheirality[wide].all()
    assert found.reprojection_errors[before].max() < 1e-6


def test_equals_opencv_without_noise_and_is_no_worse_with_it() -> None:
    points, seen0, seen1, *pose = scene(count=4000)
    np.testing.assert_allclose(
        triangulate(seen0, seen1, BOTH, *pose).points, by_opencv(seen0, seen1, *pose), rtol=1e-6
    )
    generator = np.random.default_rng(1)
    noisy0, noisy1 = (seen + generator.normal(0, 0.5, seen.shape) for seen in (seen0, seen1))
    own, other = triangulate(noisy0, noisy1, BOTH, *pose).points, by_opencv(noisy0, noisy1, *pose)
    errors = [np.median(np.linalg.norm(found - points, axis=1)) for found in (own, other)]
    assert errors[0] < 1.01 * errors[1]


def test_the_error_is_that_of_the_reprojection_and_the_least() -> None:
    _, seen0, seen1, *pose = scene()
    generator = np.random.default_rng(1)
    noisy0, noisy1 = (seen + generator.normal(0, 0.5, seen.shape) for seen in (seen0, seen1))
    found = triangulate(noisy0, noisy1, BOTH, *pose)

    def error(points: np.ndarray) -> np.ndarray:
        there = CAMERA1.project(points @ pose[0].T + pose[1])
        squares = ((CAMERA0.project(points) - noisy0) ** 2).sum(1)
        return np.sqrt((squares + ((there - noisy1) ** 2).sum(1)) / 2)

    np.testing.assert_allclose(found.reprojection_errors, error(found.points), atol=1e-3)
    assert (found.reprojection_errors <= error(by_opencv(noisy0, noisy1, *pose)) + 1e-3).all()
    refined = found.points * (1 + generator.normal(0, 1e-4, (len(noisy0), 1)))
    assert (found.reprojection_errors <= error(refined) + 1e-3).all()


def test_agrees_with_opencvs_correction() -> None:
    _, seen0, seen1, *pose = scene()
    generator = np.random.default_rng(1)
    noisy0, noisy1 = (seen + generator.normal(0, 1, seen.shape) for seen in (seen0, seen1))
    fundamental = fundamental_matrix(BOTH, *pose)
    moved = correct_matches(noisy0, noisy1, fundamental)
    assert epipolar_errors(*moved, fundamental).max() < 2e-3  # two steps, not the root
    expected = cv2.correctMatches(fundamental, noisy0[None], noisy1[None])
    for own, other in zip(moved, expected, strict=True):
        np.testing.assert_allclose(own, other[0], atol=1e-3)


def test_what_lies_behind_a_camera_is_told() -> None:
    _, seen0, seen1, rotation, translation = scene()
    assert triangulate(seen0, seen1, BOTH, rotation, translation).cheirality.all()
    assert not triangulate(seen0, seen1, BOTH, rotation, -translation).cheirality.any()
    # Before the first camera, behind the second, which has passed it.
    one = np.array([[0.1, 0.2, 2.0]])
    passed = np.array([0.3, 0, -4.0])
    seen = CAMERA0.project(one), CAMERA1.project(one + passed)
    found = triangulate(*seen, BOTH, np.eye(3), passed)
    np.testing.assert_allclose(found.points, one)
    assert not found.cheirality[0]


def test_parallel_rays_and_no_matches_raise_nothing() -> None:
    camera = Camera((640, 480), 500)
    both = Calibration(camera, camera)
    point = np.array([[100.0, 200.0]])
    found = triangulate(point, point, both, np.eye(3), np.array([-1.0, 0, 0]))
    assert not found.cheirality[0]
    assert not np.isfinite(found.points).all()
    assert found.triangulation_angle[0] == pytest.approx(0)
    assert triangulate(*np.empty((2, 0, 2)), both, np.eye(3), np.ones(3)).points.shape == (0, 3)


def test_blocks_give_what_all_at_once_gives(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera((640, 480), 500.0)
    calibration = Calibration(camera, camera)
    pose = np.eye(3), np.array([-1.0, 0.1, 0])
    points0 = np.random.default_rng(0).uniform(0, 480, (100, 2))
    points1 = points0 - [[20, 3]]
    whole = triangulate(points0, points1, calibration, *pose)
    monkeypatch.setattr(relative_pose, "BLOCK", 7)
    parts = triangulate(points0, points1, calibration, *pose)
    for name, values in vars(whole).items():
        np.testing.assert_array_equal(getattr(parts, name), values)
    assert len(triangulate([], [], calibration, *pose).points) == 0


@pytest.mark.parametrize("translation", [(-1, 0.2, 0.1), (0.05, 0.02, 1)])
def test_moved_matches_fulfil_the_constraint(translation: tuple[float, float, float]) -> None:
    """Sideways and forwards, with errors of eight pixels: the lines of sight meet."""
    _, seen0, seen1, rotation, moved = scene(translation=translation)
    random = np.random.default_rng(1)
    noisy = seen0 + random.normal(0, 8, seen0.shape), seen1 + random.normal(0, 8, seen1.shape)
    fundamental = fundamental_matrix(BOTH, rotation, moved)
    left = epipolar_errors(*correct_matches(*noisy, fundamental), fundamental)
    assert np.quantile(left, 0.99) < 1e-4
