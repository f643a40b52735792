from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.geometry import transform_points
from deepdetect.geometry.validated_refinement import (
    ValidatedRefinementOptions,
    refine_homography_validated,
)
from deepdetect.io.image import luma

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
    assert error(refine_homography_validated(gray, second, start), TRUE, gray.shape) < 0.1


def test_other_light_does_not_matter(gray: np.ndarray) -> None:
    second = np.clip(0.5 * warped(gray, TRUE).astype(float) + 60, 0, 255).astype(np.uint8)
    found = refine_homography_validated(gray, second, TRUE @ OFF)
    assert error(found, TRUE, gray.shape) < 0.15


def test_what_is_right_stays(gray: np.ndarray) -> None:
    found = refine_homography_validated(gray, warped(gray, TRUE), TRUE)
    assert error(found, TRUE, gray.shape) < 0.1


def test_a_plane_that_fills_most_of_the_image_is_not_pulled_off_it(gray: np.ndarray) -> None:
    """A third of the image moves by two pixels more: the compromise would be wrong everywhere."""
    second = warped(gray, TRUE)
    other = warped(gray, np.array([[1, 0, 2.0], [0, 1, 0], [0, 0, 1]]) @ TRUE)
    third = gray.shape[1] // 3
    second[:, :third] = other[:, :third]
    found = refine_homography_validated(gray, second, TRUE @ OFF)
    x, y = np.meshgrid(np.arange(gray.shape[1] // 2, gray.shape[1] - 30, 10), [60, 120, 180])
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    gaps = transform_points(points, found) - transform_points(points, TRUE)
    assert np.linalg.norm(gaps, axis=1).mean() < 0.3


def test_noise_gives_no_refinement() -> None:
    rng = np.random.default_rng(0)
    first, second = (rng.integers(0, 256, (120, 160), np.uint8) for _ in range(2))
    np.testing.assert_allclose(refine_homography_validated(first, second, TRUE), TRUE)


def test_flat_images_keep_the_start() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    np.testing.assert_allclose(refine_homography_validated(flat, flat, TRUE), TRUE)


@pytest.mark.parametrize(
    "wrong", [{"windows_px": (20,)}, {"parts": 1}, {"min_tracks": 3}, {"max_corners": 0}]
)
def test_options_out_of_range_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError):
        ValidatedRefinementOptions(**wrong)
