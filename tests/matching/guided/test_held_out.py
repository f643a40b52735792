"""A plane of which some matches, or all, are moved away from where it is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.transforms import transform_points
from deepdetect.matching.guided.held_out import compare_held_out

SIZE = (480, 360)
"""Width and height of both views."""

WARP = np.array([[0.95, -0.1, 40], [0.1, 0.95, -10], [1e-4, 0, 1]])


@pytest.fixture(scope="module")
def grays() -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).uniform(0, 255, SIZE[::-1])
    first = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    return first.astype(np.uint8), cv2.warpPerspective(first, WARP, SIZE).astype(np.uint8)


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    points0 = np.argwhere(np.ones(SIZE))[::3].astype(np.float64)
    points1 = transform_points(points0, WARP)
    seen = ((points1 >= 0) & (points1 < SIZE)).all(axis=1)
    return points0[seen], points1[seen]


def test_right_matches_predict_what_looks_alike(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    correlation, alike = compare_held_out(grays, *points)
    assert correlation > 0.99
    assert alike.mean() > 0.98
    correlation, alike = compare_held_out(grays, points[0], points[1] + [8, 0])
    assert correlation < 0.3
    assert alike.mean() < 0.3


def test_images_contradict_the_matches_that_are_moved(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    moved = points[0][:, 0] < 120
    correlation, alike = compare_held_out(grays, points[0], points[1] + 12.0 * moved[:, None])
    assert correlation > 0.99
    assert alike[moved].mean() < 0.2
    assert alike[~moved].mean() > 0.9


def test_of_few_matches_nothing_is_known(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    correlation, alike = compare_held_out(grays, points[0][::2000], points[1][::2000])
    assert correlation == 0
    assert alike.all()
