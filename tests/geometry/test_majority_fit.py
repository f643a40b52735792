from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.homography_accuracy import corner_error
from deepdetect.geometry.majority_fit import fit_to_majority, robust_homography, share_in_place
from deepdetect.geometry.residuals import transform_points
from deepdetect.geometry.zncc import warp_back
from deepdetect.io.image import luma

NEARLY = np.array([[1.004, 0.006, 2.0], [-0.005, 0.997, -1.5], [8e-6, -5e-6, 1.0]])
"""A homography by which points move a few pixels, as what is left to correct."""

TRUE = np.array([[0.95, 0.06, 9.0], [-0.04, 1.02, 5.0], [8e-5, -5e-5, 1.0]])


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
    found = robust_homography(points, moved(points, homography))
    assert corner_error(found, homography, (640, 480)) < 1e-4
    assert found[2, 2] == 1


def test_clean_points_give_what_opencv_gives() -> None:
    generator = np.random.default_rng(0)
    points = generator.uniform(0, (640, 480), (500, 2))
    noisy = moved(points, NEARLY) + generator.normal(0, 0.1, points.shape)
    found = robust_homography(points, noisy)
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

    found = off(robust_homography(points, there))
    plain, _ = cv2.findHomography(points, there, 0)
    magsac, _ = cv2.findHomography(points, there, cv2.USAC_MAGSAC, 1.0)
    assert off(plain) > 2
    assert found < 0.2
    assert found < off(magsac) + 0.15


def test_points_that_give_no_homography_give_none() -> None:
    line = np.column_stack([np.arange(20.0), 2 * np.arange(20.0)])
    for points in (np.zeros((0, 2)), np.eye(2), np.ones((9, 2))):
        assert robust_homography(points, points) is None
    found = robust_homography(line, line + 1)
    assert found is None or np.allclose(moved(line, found), line + 1, atol=1e-6)


def test_the_same_image_is_all_in_place_and_a_moved_one_is_not(gray: np.ndarray) -> None:
    seen = np.ones(gray.shape, bool)
    assert share_in_place(gray, gray, seen) == 1
    shares = []
    for shift in (0.1, 0.4, 0.7, 1.5):
        matrix = np.float32([[1, 0, shift], [0, 1, 0]])
        other = cv2.warpAffine(gray, matrix, gray.shape[::-1], flags=cv2.INTER_CUBIC)
        shares.append(share_in_place(gray, other, seen))
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.99
    assert shares[1] > 0.6 > 0.35 > shares[2]
    assert shares[3] < 0.2
    assert share_in_place(gray, gray, ~seen) == 0


def test_only_what_is_seen_counts(gray: np.ndarray) -> None:
    other = gray.copy()
    other[:, :256] = np.roll(gray, 2, axis=1)[:, :256]
    seen = np.ones(gray.shape, bool)
    right = seen.copy()
    right[:, :300] = False
    assert share_in_place(gray, other, seen) < 0.75
    assert share_in_place(gray, other, right) > 0.98


def test_light_does_not_matter(gray: np.ndarray) -> None:
    darker = np.clip(gray * 0.6 + 30, 0, 255).astype(np.uint8)
    assert share_in_place(gray, darker, np.ones(gray.shape, bool)) > 0.85


def test_a_right_homography_is_left_alone(gray: np.ndarray) -> None:
    other = cv2.warpPerspective(gray, TRUE, (512, 512), flags=cv2.INTER_CUBIC)
    np.testing.assert_array_equal(fit_to_majority(gray, other, TRUE), TRUE)


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
        return share_in_place(gray, *warp_back(other, homography, (512, 512)))

    found = fit_to_majority(gray, other, start)
    assert off(start) > 0.7
    assert off(found) < 0.6
    assert share(found) > 1.3 * share(start)
    assert share(found) > 0.98 * share(TRUE)
    assert found[2, 2] == 1


def test_what_would_be_no_better_is_not_taken(gray: np.ndarray) -> None:
    """A whole quarter that moved is too many for the fit: it stays with what it was given."""
    other = cv2.warpPerspective(bent(gray, 128), TRUE, (512, 512), flags=cv2.INTER_CUBIC)
    start = compromise(128)
    np.testing.assert_array_equal(fit_to_majority(gray, other, start), start)


def test_images_without_corners_give_back_what_was_given() -> None:
    flat = np.full((64, 64), 90, np.uint8)
    given_one = np.array([[1.0, 0, 2], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(fit_to_majority(flat, flat, given_one), given_one)


def test_is_the_same_on_repetition(gray: np.ndarray) -> None:
    other = bent(gray, 64)
    start = np.array([[1.0, 0, 1.2], [0, 1, 0], [0, 0, 1]])
    first, second = (fit_to_majority(gray, other, start) for _ in range(2))
    np.testing.assert_array_equal(first, second)
