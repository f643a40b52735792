"""Scale space and dominant orientations beside those of OpenCV's SIFT, and of turned images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import dominant_angles, gaussian_layers, nearest_layers
from deepdetect.io.image import luma


def test_the_layer_of_a_size_is_the_one_in_which_sift_detects_it(photo: np.ndarray) -> None:
    gray = luma(photo)
    points = sift_points(gray)
    octaves, layers = nearest_layers(points.sizes, gray.shape)
    assert len(set(octaves.tolist())) >= 3
    np.testing.assert_array_equal(octaves & 255, points.octaves & 255)
    np.testing.assert_array_equal(layers, points.octaves >> 8 & 255)


@pytest.mark.parametrize("shape", [(3, 5), (20, 30), (400, 500)])
def test_sizes_beyond_the_image_get_its_last_octave(shape: tuple[int, int]) -> None:
    octaves, layers = nearest_layers(np.array([0.0, 0.1, 1e6]), shape)
    assert octaves[:2].tolist() == [-1, -1]
    assert 0 <= octaves[2] <= max(0, np.log2(min(shape) / 8))
    assert set(layers.tolist()) <= {1, 2, 3}


def test_layers_are_the_blurred_image_at_their_scale() -> None:
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128)).astype(np.float32), (0, 0), 2)
    before = 0.5
    for octave, layer, image in gaussian_layers(gray, -1, 2):
        sigma = 1.6 * 2 ** (octave + layer / 3)
        whole = cv2.GaussianBlur(gray, (0, 0), (sigma**2 - before**2) ** 0.5)
        step = 2.0**octave
        inner = [
            (row, column)
            for row in range(12, image.shape[0] - 12, 5)
            for column in range(12, image.shape[1] - 12, 5)
            if row * step % 1 == column * step % 1 == 0
        ]
        for row, column in inner:
            expected = whole[int(row * step), int(column * step)]
            assert image[row, column] == pytest.approx(expected, abs=3)


def gap(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs((first - second + 180) % 360 - 180)


def sift_points(gray: np.ndarray) -> Keypoints:
    found = cv2.SIFT_create(contrastThreshold=0.01, enable_precise_upscale=True).detect(gray, None)
    return Keypoints.from_opencv(found, gray.shape[::-1])


def test_angles_are_those_of_sift(photo: np.ndarray) -> None:
    gray = luma(photo)
    points = sift_points(gray)
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
