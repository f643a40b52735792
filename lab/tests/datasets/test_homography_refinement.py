from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.homography_refinement import refine_homography
from deepdetect_lab.datasets.planar import read_matrix

TRUE = np.array([[0.97, 0.05, 8.3], [-0.04, 1.02, -5.6], [4e-5, -3e-5, 1.0]])
OFF = np.array([[1.0, 0.004, 2.4], [-0.003, 1.0, -1.7], [0, 0, 1.0]])


def warped(gray: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = (gray.shape[1], gray.shape[0])
    return cv2.warpPerspective(gray, homography, size, flags=cv2.INTER_CUBIC)


def error(found: np.ndarray, true: np.ndarray, shape: tuple[int, ...]) -> float:
    """Return the mean distance of both over the image, in pixels."""
    x, y = np.meshgrid(np.arange(20, shape[1] - 20, 10), np.arange(20, shape[0] - 20, 10))
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    gaps = transform_points(points, found) - transform_points(points, true)
    return float(np.linalg.norm(gaps, axis=1).mean())


@pytest.fixture(scope="module")
def gray(photo: np.ndarray) -> np.ndarray:
    return luma(photo)


def test_a_homography_that_is_off_by_pixels_is_found(gray: np.ndarray) -> None:
    second = warped(gray, TRUE)
    start = TRUE @ OFF
    assert error(start, TRUE, gray.shape) > 2
    assert error(refine_homography(gray, second, start), TRUE, gray.shape) < 0.1


def test_other_light_does_not_matter(gray: np.ndarray) -> None:
    second = np.clip(0.5 * warped(gray, TRUE).astype(float) + 60, 0, 255).astype(np.uint8)
    found = refine_homography(gray, second, TRUE @ OFF)
    assert error(found, TRUE, gray.shape) < 0.15


def test_a_plane_that_fills_most_of_the_image_is_not_pulled_off_it(gray: np.ndarray) -> None:
    """A third of the image moves by two pixels more: the compromise would be wrong everywhere."""
    second = warped(gray, TRUE)
    other = warped(gray, np.array([[1, 0, 2.0], [0, 1, 0], [0, 0, 1]]) @ TRUE)
    third = gray.shape[1] // 3
    second[:, :third] = other[:, :third]
    found = refine_homography(gray, second, TRUE @ OFF)
    x, y = np.meshgrid(np.arange(gray.shape[1] // 2, gray.shape[1] - 30, 10), [60, 120, 180])
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    gaps = transform_points(points, found) - transform_points(points, TRUE)
    assert np.linalg.norm(gaps, axis=1).mean() < 0.3


def test_flat_images_keep_the_start() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    np.testing.assert_allclose(refine_homography(flat, flat, TRUE), TRUE)


def displacement(
    first: np.ndarray, second: np.ndarray, image0: np.ndarray, image1: np.ndarray
) -> tuple[float, float]:
    """Median and largest distance in pixels by which two homographies map the overlap apart."""
    row, column = np.indices(image0.shape[:2])
    grid = np.column_stack([column.ravel(), row.ravel()])
    mapped, other = transform_points(grid, first), transform_points(grid, second)
    inside = ((mapped >= 0) & (mapped <= np.array(image1.shape[1::-1]) - 1)).all(axis=1)
    gaps = np.linalg.norm(mapped[inside] - other[inside], axis=1)
    return float(np.median(gaps)), float(gaps.max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "median", "largest"),
    [("wall-2", 0.1, 0.3), ("bark-3", 0.1, 0.3), ("bikes-6", 0.3, 1.0), ("graf-6", 0.3, 1.6)],
)
def test_agrees_with_the_refined_homographies_of_oxford(
    shared: Path, name: str, median: float, largest: float
) -> None:
    """From the published one, whose points are up to 5 px off."""
    scene, number = name.split("-")
    folder = shared / "data" / "oxford" / scene
    images = [load_image(folder / f"img{k}.png") for k in (1, int(number))]
    published = read_matrix(folder / f"H1to{number}p")
    expected = read_matrix(folder / f"H1to{number}p.refined")
    found = refine_homography(*map(luma, images), published)
    assert displacement(expected, published, *images)[0] > median
    found_median, found_largest = displacement(expected, found, *images)
    assert found_median < median
    assert found_largest < largest


@pytest.mark.parametrize("shift", [0.25, 0.3, 0.75])
def test_a_shift_by_a_fraction_of_a_pixel_is_found(waves, shift: float) -> None:
    """Known answer: an image that is a sum of waves, where no reading has part in the truth."""
    true = np.array([[1, 0, shift], [0, 1, -shift], [0, 0, 1.0]])
    first, second = waves(0, 0), waves(shift, -shift)
    assert error(refine_homography(first, second, np.eye(3)), true, first.shape) < 0.03
