"""Dominant orientations beside those of OpenCV's SIFT, and of turned images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import dominant_angles
from deepdetect.io.image import luma


def gap(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs((first - second + 180) % 360 - 180)


def sift_points(gray: np.ndarray) -> Keypoints:
    found = cv2.SIFT_create(contrastThreshold=0.01, enable_precise_upscale=True).detect(gray, None)
    return Keypoints.from_opencv(found, gray.shape[::-1])


def test_angles_are_those_of_sift(photo: np.ndarray) -> None:
    gray = luma(photo)
    points = sift_points(gray)
    assert points.sizes is not None
    assert points.angles is not None
    away = gap(dominant_angles(gray, points.xy, points.sizes), points.angles)
    # SIFT has some places for several orientations: the nearest of them counts.
    places = np.column_stack([points.xy, points.sizes])
    _, rows = np.unique(places, axis=0, return_inverse=True)
    nearest = np.full(rows.max() + 1, 360.0)
    np.minimum.at(nearest, rows.ravel(), away)
    assert len(nearest) > 100
    assert np.mean(nearest < 1) > 0.98


@pytest.mark.parametrize("degrees", [0.0, 37.0, 90.0, 215.0, 330.0])
@pytest.mark.parametrize("size", [3.0, 8.0, 21.0])
def test_a_slope_points_up_its_slope(degrees: float, size: float) -> None:
    row, column = np.indices((101, 101)) - 50
    turn = np.radians(degrees)
    slope = 128 + 1.2 * (np.cos(turn) * column + np.sin(turn) * row)
    (found,) = dominant_angles(np.uint8(np.rint(slope)), np.array([[50, 50]]), np.array([size]))
    assert gap(found, degrees) < 6


def test_angles_turn_with_the_image(photo: np.ndarray) -> None:
    gray = luma(photo)
    points = sift_points(gray)
    assert points.sizes is not None
    turned = np.ascontiguousarray(np.rot90(gray))  # anticlockwise
    x, y = points.xy.T
    there = np.column_stack([y, gray.shape[1] - 1 - x])
    before = dominant_angles(gray, points.xy, points.sizes)
    after = dominant_angles(turned, there, points.sizes)
    assert np.mean(gap(after, before - 90) < 3) > 0.9


def test_flat_and_tiny_images_and_no_points_are_no_error() -> None:
    flat = np.full((40, 40), 99, np.uint8)
    assert dominant_angles(flat, np.array([[20, 20], [0, 39]]), np.array([4, 90])).tolist() == [
        0,
        0,
    ]
    assert dominant_angles(flat[:2, :3], np.array([[1, 1]]), np.array([9])).shape == (1,)
    none = dominant_angles(flat, np.empty((0, 2)), np.empty(0))
    assert (none.shape, none.dtype) == ((0,), np.float32)


def test_all_angles_are_within_a_turn() -> None:
    rng = np.random.default_rng(0)
    gray = rng.integers(0, 256, (90, 120)).astype(np.uint8)
    xy = rng.uniform(0, (119, 89), (500, 2))
    found = dominant_angles(gray, xy, rng.uniform(1, 40, 500))
    assert found.dtype == np.float32
    assert ((found >= 0) & (found < 360)).all()
