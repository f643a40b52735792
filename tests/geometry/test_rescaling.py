from __future__ import annotations

import numpy as np
import pytest

from deepdetect.geometry import epipolar_errors, transform_points
from deepdetect.geometry.images import downscale
from deepdetect.geometry.transforms import scaled_fundamental, scaled_homography, scaled_points

MILD = np.array([[0.9, -0.12, 25.0], [0.15, 0.95, -8.0], [2e-4, -1e-4, 1.0]])


def spot(x: float, y: float, width: int, height: int) -> np.ndarray:
    row, column = np.indices((height, width))
    return np.rint(220 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / 72)).astype(np.uint8)


def centre(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.array([(gray * column).sum(), (gray * row).sum()]) / gray.sum(dtype=float)


@pytest.mark.parametrize(
    ("x", "y", "width", "height"),
    [
        (30, 20, 300, 262),
        (500, 230, 600, 300),
        (560, 120, 600, 140),
        (560, 120, 600, 142),  # shrinks to 47.3 rows, so to 47
        (80, 560, 101, 600),  # to 33.7 columns, so to 34
    ],
)
def test_a_spot_is_where_its_scaled_position_says(x: int, y: int, width: int, height: int) -> None:
    small, scale = downscale(spot(x, y, width, height), 200)
    assert max(small.shape) == 200
    np.testing.assert_allclose(centre(small), scaled_points(np.array([x, y]), scale), atol=0.05)


def test_a_scaled_homography_maps_scaled_points() -> None:
    points = np.random.default_rng(0).uniform(0, 300, (20, 2))
    matrix = scaled_homography(MILD, 2.5, 0.3)
    expected = scaled_points(transform_points(points, MILD), 0.3)
    np.testing.assert_allclose(transform_points(scaled_points(points, 2.5), matrix), expected)
    assert matrix[2, 2] == 1
    back = scaled_homography(matrix, 1 / 2.5, 1 / 0.3)
    np.testing.assert_allclose(back, MILD, atol=1e-9)


def test_a_scaled_fundamental_matrix_fits_scaled_points() -> None:
    generator = np.random.default_rng(0)
    fundamental = np.cross(np.eye(3), generator.normal(size=3)) @ generator.normal(size=(3, 3))
    points0, points1 = generator.uniform(0, 300, (2, 20, 2))
    homogeneous = np.column_stack([points0, np.ones(20)])
    a, b, c = (homogeneous @ fundamental.T).T
    points1[:, 1] = -(a * points1[:, 0] + c) / b  # on their epipolar lines
    matrix = scaled_fundamental(fundamental, 2.5, 0.3)
    scaled = scaled_points(points0, 2.5), scaled_points(points1, 0.3)
    np.testing.assert_allclose(epipolar_errors(*scaled, matrix), 0, atol=1e-8)
