from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared.errors import OptionError
from deepdetect.datasets.types import read_homography
from deepdetect.evaluation.metrics.homography import corner_error
from deepdetect.geometry.homography_refinement import (
    RefinementOptions,
    aligned_fraction,
    fit_homography_irls,
    refine_homography,
    refine_homography_irls,
)
from deepdetect.geometry.residuals import transform_points
from deepdetect.geometry.zncc import warp_to_reference
from deepdetect.io.image import load_image, luma

TRUE = np.array([[0.95, 0.06, 9.0], [-0.04, 1.02, 5.0], [8e-5, -5e-5, 1.0]])


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A photograph, and the same seen through `TRUE` in other light."""
    gray = luma(photo)
    moved = cv2.warpPerspective(gray, TRUE, (256, 256), flags=cv2.INTER_CUBIC)
    return gray, np.clip(moved * 0.6 + 30, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("seed", range(4))
def test_finds_the_true_homography_from_some_pixels_away(
    pair: tuple[np.ndarray, np.ndarray], seed: int
) -> None:
    generator = np.random.default_rng(seed)
    start = TRUE.copy()
    start[:2, 2] += generator.uniform(-4, 4, 2)
    start[:2, :2] += generator.uniform(-0.01, 0.01, (2, 2))
    assert corner_error(start, TRUE, (256, 256)) > 1
    found = refine_homography(*pair, start)
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.25
    assert found.zncc > found.initial_zncc
    assert found.steps >= 1
    assert found.homography[2, 2] == 1


def test_never_makes_it_worse(pair: tuple[np.ndarray, np.ndarray]) -> None:
    found = refine_homography(*pair, TRUE)
    assert found.zncc >= found.initial_zncc
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.25


def test_keeps_what_it_is_given_where_nothing_can_be_tracked() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    start = np.array([[1.0, 0, 2], [0, 1, 0], [0, 0, 1]])
    found = refine_homography(flat, flat, start)
    np.testing.assert_array_equal(found.homography, start)
    assert found.steps == 0


def test_the_callers_random_numbers_are_left_alone(pair: tuple[np.ndarray, np.ndarray]) -> None:
    cv2.setRNGSeed(5)
    expected = cv2.randu(np.zeros(4), 0, 1).copy()
    cv2.setRNGSeed(5)
    refine_homography(*pair, TRUE @ np.array([[1.0, 0, 2], [0, 1, -1], [0, 0, 1]]))
    np.testing.assert_array_equal(cv2.randu(np.zeros(4), 0, 1), expected)


def test_is_the_same_on_repetition(pair: tuple[np.ndarray, np.ndarray]) -> None:
    start = TRUE @ np.array([[1.0, 0, 2], [0, 1, -1], [0, 0, 1]])
    first, second = (refine_homography(*pair, start).homography for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_rounds": 0},
        {"max_corners": 5},
        {"windows_px": ()},
        {"windows_px": (3,)},
        {"blur_sigmas_px": (0,)},
        {"ignored_fraction": 1},
    ],
)
def test_options_out_of_range_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError):
        RefinementOptions(**wrong)


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
    published = read_homography(folder / f"H1to{number}p")
    expected = read_homography(folder / f"H1to{number}p.refined")
    found = refine_homography(*map(luma, images), published)
    assert displacement(expected, published, *images)[0] > median
    found_median, found_largest = displacement(expected, found.homography, *images)
    assert found_median < median
    assert found_largest < largest


def test_moving_parts_are_ignored(pair: tuple[np.ndarray, np.ndarray]) -> None:
    first, second = pair
    moved = second.copy()
    moved[60:160, 70:150] = np.roll(second[60:160, 70:150], 2, axis=1)
    start = TRUE @ np.array([[1.0, 0, 0.6], [0, 1, -0.5], [0, 0, 1]])
    found = refine_homography(first, moved, start, RefinementOptions(windows_px=(21,)))
    assert corner_error(found.homography, TRUE, (256, 256)) < 0.3


NEARLY = np.array([[1.004, 0.006, 2.0], [-0.005, 0.997, -1.5], [8e-6, -5e-6, 1.0]])
"""A homography by which points move a few pixels, as what is left to correct."""


def moved(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    return transform_points(points, homography)


@pytest.fixture(scope="module")
def gray(photo: np.ndarray) -> np.ndarray:
    return cv2.resize(luma(photo), (512, 512), interpolation=cv2.INTER_CUBIC)


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
    found = fit_homography_irls(points, moved(points, homography))
    assert corner_error(found, homography, (640, 480)) < 1e-4
    assert found[2, 2] == 1


def test_clean_points_give_what_opencv_gives() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform(0, (640, 480), (500, 2))
    noisy = moved(points, NEARLY) + generator.normal(0, 0.1, points.shape)
    found = fit_homography_irls(points, noisy)
    expected, _ = cv2.findHomography(points, noisy, 0)
    assert corner_error(found, expected, (640, 480)) < 0.02
    assert corner_error(found, NEARLY, (640, 480)) < 0.1


def test_wrong_points_pull_less_than_in_least_squares_and_no_more_than_in_magsac() -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform(0, (640, 480), (600, 2))
    there = moved(points, NEARLY) + generator.normal(0, 0.1, points.shape)
    there[points[:, 0] < 80] += [4, -3]
    wild = generator.random(600) < 0.1
    there[wild] += generator.normal(0, 30, (wild.sum(), 2))
    rest = np.array([[100.0, 0], [640, 0], [640, 480], [100, 480]])

    def off(homography: np.ndarray) -> float:
        return float(np.linalg.norm(moved(rest, homography) - moved(rest, NEARLY), axis=1).max())

    found = off(fit_homography_irls(points, there))
    plain, _ = cv2.findHomography(points, there, 0)
    magsac, _ = cv2.findHomography(points, there, cv2.USAC_MAGSAC, 1.0)
    assert off(plain) > 2
    assert found < 0.2
    assert found < off(magsac) + 0.15


def test_points_that_give_no_homography_give_none() -> None:
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    for points in (np.zeros((0, 2)), np.eye(2), np.ones((9, 2))):
        assert fit_homography_irls(points, points) is None
    found = fit_homography_irls(line, line + 1)
    assert found is None or np.allclose(moved(line, found), line + 1, atol=1e-6)


def test_the_same_image_is_all_in_place_and_a_moved_one_is_not(gray: np.ndarray) -> None:
    seen = np.ones(gray.shape, bool)
    assert aligned_fraction(gray, gray, seen) == 1
    shares = []
    for shift in (0.1, 0.4, 0.7, 1.5):
        matrix = np.float32([[1, 0, shift], [0, 1, 0]])
        other = cv2.warpAffine(gray, matrix, gray.shape[::-1], flags=cv2.INTER_CUBIC)
        shares.append(aligned_fraction(gray, other, seen))
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.99
    assert shares[1] > 0.6 > 0.35 > shares[2]
    assert shares[3] < 0.2
    assert aligned_fraction(gray, gray, ~seen) == 0


def test_only_what_is_seen_counts(gray: np.ndarray) -> None:
    other = gray.copy()
    other[:, :256] = np.roll(gray, 2, axis=1)[:, :256]
    seen = np.ones(gray.shape, bool)
    right = seen.copy()
    right[:, :300] = False
    assert aligned_fraction(gray, other, seen) < 0.75
    assert aligned_fraction(gray, other, right) > 0.98


def test_light_does_not_matter(gray: np.ndarray) -> None:
    darker = np.clip(gray * 0.6 + 30, 0, 255).astype(np.uint8)
    assert aligned_fraction(gray, darker, np.ones(gray.shape, bool)) > 0.85


def test_a_right_homography_is_left_alone(gray: np.ndarray) -> None:
    other = cv2.warpPerspective(gray, TRUE, (512, 512), flags=cv2.INTER_CUBIC)
    np.testing.assert_array_equal(refine_homography_irls(gray, other, TRUE), TRUE)


def bent(gray: np.ndarray, width: int) -> np.ndarray:
    """Move the left part of an image 3 pixels to the right."""
    y, x = np.indices(gray.shape, np.float32)
    return cv2.remap(gray, np.where(x < width, x - 3, x), y, cv2.INTER_CUBIC)


def compromise(width: int) -> np.ndarray:
    """What fits all pixels in least squares: that part pulls everything along."""
    grid = np.stack(np.meshgrid(np.arange(0, 512, 8.0), np.arange(0, 512, 8.0)), -1).reshape(-1, 2)
    there = moved(grid + [3, 0] * (grid[:, :1] < width), TRUE)
    return cv2.findHomography(grid, there, 0)[0]


def test_one_that_a_minority_pulled_off_is_mended(gray: np.ndarray) -> None:
    other = cv2.warpPerspective(bent(gray, 64), TRUE, (512, 512), flags=cv2.INTER_CUBIC)
    start = compromise(64)
    rest = np.array([[100, 0], [511, 0], [511, 511], [100, 511.0]])

    def off(homography: np.ndarray) -> float:
        return float(np.linalg.norm(moved(rest, homography) - moved(rest, TRUE), axis=1).max())

    def share(homography: np.ndarray) -> float:
        return aligned_fraction(gray, *warp_to_reference(other, homography, (512, 512)))

    found = refine_homography_irls(gray, other, start)
    assert off(start) > 0.7
    assert off(found) < 0.6
    assert share(found) > 1.3 * share(start)
    assert share(found) > 0.98 * share(TRUE)
    assert found[2, 2] == 1


def test_what_would_be_no_better_is_not_taken(gray: np.ndarray) -> None:
    """A whole quarter that moved is too many for the fit: it stays with what it was given."""
    other = cv2.warpPerspective(bent(gray, 128), TRUE, (512, 512), flags=cv2.INTER_CUBIC)
    start = compromise(128)
    np.testing.assert_array_equal(refine_homography_irls(gray, other, start), start)


def test_images_without_corners_give_back_what_was_given() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    given_one = np.array([[1.0, 0, 2], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(refine_homography_irls(flat, flat, given_one), given_one)


def test_irls_is_the_same_on_repetition(gray: np.ndarray) -> None:
    other = bent(gray, 64)
    start = np.array([[1.0, 0, 1.2], [0, 1, 0], [0, 0, 1]])
    first, second = (refine_homography_irls(gray, other, start) for _ in range(2))
    np.testing.assert_array_equal(first, second)
