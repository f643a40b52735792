from __future__ import annotations

import cv2
import numpy as np
import pytest
from skimage.transform import FundamentalMatrixTransform, ProjectiveTransform

from deepdetect.geometry import (
    disparity_errors,
    epipolar_errors,
    transfer_errors,
    transform_points,
)
from deepdetect.geometry.images import downscale
from deepdetect.geometry.transforms import (
    epipolar_slopes,
    homography_derivatives,
    scaled_fundamental,
    scaled_homography,
    scaled_points,
    signed_epipolar_errors,
)


def cross_matrix(t: np.ndarray) -> np.ndarray:
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def project(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    image = points @ camera.T
    return image[:, :2] / image[:, 2:]


def two_cameras(seed: int = 0, count: int = 50) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points seen by two different cameras, and the fundamental matrix from its definition."""
    rng = np.random.default_rng(seed)
    scene = rng.uniform([-2, -2, 4], [2, 2, 9], (count, 3))
    camera0 = np.array([[500, 0, 320], [0, 520, 240], [0, 0, 1]])
    camera1 = np.array([[700, 0, 300], [0, 690, 260], [0, 0, 1]])
    turn, shift = cv2.Rodrigues(np.array([0.05, -0.1, 0.2]))[0], np.array([0.5, 0.1, -0.2])
    points0 = project(scene, camera0)
    points1 = project(scene @ turn.T + shift, camera1)
    essential = cross_matrix(shift) @ turn
    fundamental = np.linalg.inv(camera1).T @ essential @ np.linalg.inv(camera0)
    return points0, points1, fundamental


HOMOGRAPHY = np.array([[1.1, 0.05, -12.0], [-0.04, 0.95, 7.0], [1e-4, -2e-4, 1.0]])
RECTIFIED = np.array([[0, 0, 0], [0, 0, -1], [0, 1, 0]], float)
"""The fundamental matrix of a rectified pair: matches lie in the same row."""


def test_transform_equals_scikit_image() -> None:
    points = np.random.default_rng(0).uniform(0, 500, (100, 2))
    expected = ProjectiveTransform(HOMOGRAPHY)(points)
    mapped = transform_points(points, HOMOGRAPHY)
    assert mapped.dtype == np.float64
    np.testing.assert_allclose(mapped, expected, rtol=1e-12)


def test_a_point_without_an_image_is_at_infinity() -> None:
    """The kernel of a singular matrix: (0, 0, 0) / 0."""
    homography = np.diag([1.0, 1.0, 0.0])
    np.testing.assert_array_equal(transform_points([[0, 0]], homography), [[np.inf, np.inf]])


@pytest.mark.parametrize(
    ("homography", "offset", "expected"),
    [
        ([[1, 0, 3], [0, 1, 4], [0, 0, 1]], (3, 4), 0),
        ([[1, 0, 3], [0, 1, 4], [0, 0, 1]], (0, 0), 5),
        ([[1, 0, 3], [0, 1, 4], [0, 0, 1]], (3, 2.5), 1.5),
    ],
)
def test_transfer_errors_known_answers(homography, offset, expected) -> None:
    points = np.random.default_rng(0).uniform(0, 100, (20, 2))
    errors = transfer_errors(points, points + offset, np.array(homography, float))
    np.testing.assert_allclose(errors, np.full(20, float(expected)), atol=1e-9)


def test_true_matches_of_a_scene_lie_on_their_epipolar_lines() -> None:
    points0, points1, fundamental = two_cameras()
    np.testing.assert_allclose(epipolar_errors(points0, points1, fundamental), 0, atol=1e-9)
    # The matrix the other way round is another model.
    assert np.median(epipolar_errors(points0, points1, fundamental.T)) > 5


def test_sampson_equals_scikit_image() -> None:
    points0, points1, fundamental = two_cameras()
    points1 = points1 + np.random.default_rng(1).normal(0, 3, points1.shape)
    expected = FundamentalMatrixTransform(fundamental).residuals(points0, points1)
    errors = epipolar_errors(points0, points1, fundamental)
    np.testing.assert_allclose(errors, expected, rtol=1e-9)
    assert np.median(errors) > 0.5


@pytest.mark.parametrize(
    ("dx", "dy", "expected"),
    [(0, 0, 0), (40, 0, 0), (0, 1, 1 / np.sqrt(2)), (-7, -3, 3 / np.sqrt(2))],
)
def test_sampson_of_a_rectified_pair_is_the_row_difference_shared_by_both_images(
    dx: float, dy: float, expected: float
) -> None:
    """Both points move half of dy to meet: sqrt(2 * (dy / 2)^2) = |dy| / sqrt(2)."""
    points = np.random.default_rng(0).uniform(0, 100, (20, 2))
    errors = epipolar_errors(points, points + [dx, dy], RECTIFIED)
    np.testing.assert_allclose(errors, np.full(20, expected), atol=1e-9)


def make_disparity() -> np.ndarray:
    """10 rows, 20 columns, each pixel its own disparity."""
    return np.arange(200, dtype=float).reshape(10, 20) / 10


@pytest.mark.parametrize(
    ("point0", "point1", "expected"),
    [
        ((5, 2), (5 - 4.5, 2), 0),  # row 2, column 5 holds 4.5
        ((5, 2), (5 - 4.5 + 1.5, 2), 1.5),
        ((5, 2), (5 - 4.5 + 3, 6), 5),
        ((5, 2), (5 + 4.5, 2), 9),  # the wrong sign is wrong
        ((5.3, 1.8), (5.3 - 4.5, 1.8), 0),  # read at the nearest pixel, (5, 2)
        ((19, 9), (19 - 19.9, 9), 0),  # the last pixel
    ],
)
def test_disparity_known_answers(point0, point1, expected) -> None:
    errors = disparity_errors(np.array([point0]), np.array([point1]), make_disparity())
    assert errors.shape == (1,)
    np.testing.assert_allclose(errors, [expected], atol=1e-9)


@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf])
def test_unknown_disparity_gives_nan(unknown: float) -> None:
    disparity = make_disparity()
    disparity[2, 5] = unknown
    points0 = np.array([[5.0, 2.0], [6.0, 2.0]])
    points1 = np.array([[0.5, 2.0], [1.4, 2.0]])
    errors = disparity_errors(points0, points1, disparity)
    np.testing.assert_allclose(errors, [np.nan, 0], atol=1e-9)


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


def test_derivatives_of_epipolar_errors_by_the_matrix() -> None:
    points0, points1, fundamental = two_cameras()
    points1 = points1 + np.random.default_rng(1).normal(0, 2, points1.shape)
    matrix = fundamental / np.linalg.norm(fundamental)
    slopes, step = epipolar_slopes(points0, points1, matrix), 1e-8
    for number, axis in enumerate(np.eye(9).reshape(9, 3, 3) * step):
        ahead, behind = (
            signed_epipolar_errors(points0, points1, matrix + sign * axis) for sign in (1, -1)
        )
        expected = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(slopes[:, number], expected, rtol=1e-4, atol=1e-3)


def test_derivatives_of_a_homography() -> None:
    homography = np.array([[1.1, 0.2, 5], [-0.1, 0.9, 7], [4e-4, -3e-4, 1]])
    points, step = np.random.default_rng(0).uniform(0, 500, (20, 2)), 1e-4
    found = homography_derivatives(points, homography)
    for axis in (0, 1):
        moves = np.eye(2)[axis] * step
        ahead, behind = (transform_points(points + s * moves, homography) for s in (1, -1))
        np.testing.assert_allclose(found[:, :, axis], (ahead - behind) / (2 * step), atol=1e-6)
