from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.planar import read_matrix
from deepdetect_lab.evaluation.metrics.homography import corner_error

FILE = Path(__file__).parents[3] / "benchmarks" / "homography_refinement.py"
SPEC = importlib.util.spec_from_file_location("homography_refinement", FILE)
MODULE = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(MODULE)
refine_homography, fit_homography_irls = MODULE.refine_homography, MODULE.fit_homography_irls

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


NEARLY = np.array([[1.004, 0.006, 2.0], [-0.005, 0.997, -1.5], [8e-6, -5e-6, 1.0]])
"""A homography by which points move a few pixels, as what is left to correct."""


@given(
    seed=st.integers(0, 2**31),
    turn=st.floats(-0.02, 0.02),
    scale=st.floats(0.99, 1.01),
    across=st.floats(-5, 5),
    bend=st.floats(-2e-5, 2e-5),
)
def test_finds_any_small_homography_of_clean_points(
    seed: int, turn: float, scale: float, across: float, bend: float
) -> None:
    points = np.random.default_rng(seed).uniform(0, (640, 480), (60, 2))
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    homography = np.array([[cos, -sin, across], [sin, cos, -across], [bend, -bend, 1.0]])
    found = fit_homography_irls(points, transform_points(points, homography))
    assert corner_error(found, homography, (640, 480)) < 1e-4
    assert found[2, 2] == 1


def test_wrong_points_pull_less_than_in_least_squares_and_no_more_than_in_magsac() -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform(0, (640, 480), (600, 2))
    there = transform_points(points, NEARLY) + generator.normal(0, 0.1, points.shape)
    there[points[:, 0] < 80] += [4, -3]
    wild = generator.random(600) < 0.1
    there[wild] += generator.normal(0, 30, (wild.sum(), 2))
    rest = np.array([[100.0, 0], [640, 0], [640, 480], [100, 480]])

    def off(homography: np.ndarray) -> float:
        gaps = transform_points(rest, homography) - transform_points(rest, NEARLY)
        return float(np.linalg.norm(gaps, axis=1).max())

    found = off(fit_homography_irls(points, there))
    plain, _ = cv2.findHomography(points, there, 0)
    magsac, _ = cv2.findHomography(points, there, cv2.USAC_MAGSAC, 1.0)
    assert off(plain) > 2
    assert found < 0.2
    assert found < off(magsac) + 0.15
