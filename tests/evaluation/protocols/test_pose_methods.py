from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect
from deepdetect.evaluation.baselines.opencv import CLASSICAL
from deepdetect.evaluation.context import BenchmarkContext
from deepdetect.evaluation.metrics.pose import rotation_error, translation_error
from deepdetect.evaluation.options import BenchmarkOptions
from deepdetect.evaluation.protocols.pose_methods import (
    SIFT,
    STRAIGHT_AHEAD,
    estimate_pose,
    pose_methods,
    straight_ahead,
)

FIRST = np.array([[500.0, 0, 310], [0, 520, 250], [0, 0, 1]])
SECOND = np.array([[900.0, 0, 450], [0, 880, 280], [0, 0, 1]])
ROTATION = cv2.Rodrigues(np.array([0.05, -0.2, 0.1]))[0]
TRANSLATION = np.array([-0.9, 0.1, 0.3])


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    """300 matches of cameras with other focal lengths, to 0.3 px."""
    rng = np.random.default_rng(1)
    world = rng.uniform((-4, -3, 6), (4, 3, 16), (300, 3))
    seen = world, world @ ROTATION.T + TRANSLATION
    first, second = (
        (one @ camera.T / one[:, 2:])[:, :2] + rng.normal(0, 0.3, (300, 2))
        for one, camera in zip(seen, (FIRST, SECOND), strict=True)
    )
    return first, second


@pytest.mark.parametrize("wrong", [0, 100])
def test_the_pose_is_found_among_wrong_matches(points, wrong: int) -> None:
    first, second = points
    second = second.copy()
    second[:wrong] = np.random.default_rng(2).uniform(0, 600, (wrong, 2))
    rotation, translation = estimate_pose(first, second, FIRST, SECOND)
    assert rotation_error(rotation, ROTATION) < 0.3
    assert translation_error(translation, TRANSLATION) < 1.5
    assert np.linalg.norm(translation) == pytest.approx(1)


def test_each_image_has_its_own_intrinsics(points) -> None:
    found = estimate_pose(*points, FIRST, FIRST)
    assert found is None or rotation_error(found[0], ROTATION) > 3


def test_the_same_matches_give_the_same_pose(points) -> None:
    once = estimate_pose(*points, FIRST, SECOND)
    cv2.setRNGSeed(7)
    again = estimate_pose(*points, FIRST, SECOND)
    np.testing.assert_array_equal(once[0], again[0])
    np.testing.assert_array_equal(once[1], again[1])
    cv2.setRNGSeed(5)
    expected = cv2.randu(np.zeros(4), 0, 1).copy()
    cv2.setRNGSeed(5)
    estimate_pose(*points, FIRST, SECOND)
    np.testing.assert_array_equal(cv2.randu(np.zeros(4), 0, 1), expected)


def test_far_points_do_not_lose_their_side() -> None:
    """A hundred baselines away, where OpenCV's default leaves points out."""
    world = np.random.default_rng(0).uniform((-60, -40, 90), (60, 40, 200), (400, 3))
    first, second = ((p @ FIRST.T / p[:, 2:])[:, :2] for p in (world, world - [1.0, 0, 0]))
    _, translation = estimate_pose(first, second, FIRST, FIRST)
    assert translation_error(translation, np.array([-1.0, 0, 0])) < 5


@pytest.mark.parametrize("count", [0, 5, 20])
def test_without_enough_matches_there_is_no_pose(count: int) -> None:
    same = np.full((count, 2), 50.0)
    assert estimate_pose(same, same, FIRST, SECOND) is None


def test_straight_ahead_has_the_second_camera_before_the_first() -> None:
    rotation, translation = straight_ahead()
    assert (-rotation.T @ translation).tolist() == [0, 0, 1]


def test_the_rows_are_those_that_were_chosen(edge_detector: DeepDetect, tmp_path: Path) -> None:
    def titles(**chosen) -> list[str]:
        options = BenchmarkOptions(edge_detector, **chosen)
        return [method.title for method in pose_methods(BenchmarkContext(tmp_path), options)]

    own = ["DeepDetect", "DeepDetect, unguided"]
    assert titles() == [*own, SIFT, "ORB, ratio 0.8", STRAIGHT_AHEAD]
    assert titles(classical=()) == [*own, STRAIGHT_AHEAD]
    assert titles(classical=("sift",), others=(CLASSICAL["sift"], CLASSICAL["brisk"])) == [
        *(*own, SIFT, "BRISK, ratio 0.8", STRAIGHT_AHEAD),
    ]
