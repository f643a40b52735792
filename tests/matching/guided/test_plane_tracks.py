from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect.geometry import transfer_errors, transform_points
from deepdetect.io.image import luma
from deepdetect.matching.guided import ImagePair, Sources
from deepdetect.matching.guided.plane_tracks import PlaneTracks
from deepdetect.matching.guided.proposals import planes
from deepdetect_lab.datasets.middlebury import load_middlebury

from .conftest import WARP

TRUE = np.array([[0.97, 0.05, 8.3], [-0.04, 1.02, -5.6], [4e-5, -3e-5, 1.0]])
OFF = np.array([[1.0, 0.004, 2.4], [-0.003, 1.0, -1.7], [0, 0, 1.0]])


def warped(gray: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = (gray.shape[1], gray.shape[0])
    return cv2.warpPerspective(gray, homography, size, flags=cv2.INTER_CUBIC)


def error(found: np.ndarray, shape: tuple[int, ...], first_column: int = 20) -> float:
    """Return the mean distance from `TRUE` over the image, in pixels."""
    x, y = np.meshgrid(np.arange(first_column, shape[1] - 20, 10), np.arange(20, shape[0] - 20, 10))
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    gaps = transform_points(points, found) - transform_points(points, TRUE)
    return float(np.linalg.norm(gaps, axis=1).mean())


def refined(first: np.ndarray, second: np.ndarray, start: np.ndarray) -> np.ndarray:
    return PlaneTracks(ImagePair((first, second)), start).homography


@pytest.fixture(scope="module")
def gray(photo: np.ndarray) -> np.ndarray:
    return luma(photo)


def test_a_homography_that_is_off_by_pixels_is_found(gray: np.ndarray) -> None:
    start = TRUE @ OFF
    assert error(start, gray.shape) > 2
    assert error(refined(gray, warped(gray, TRUE), start), gray.shape) < 0.1


def test_other_light_does_not_matter(gray: np.ndarray) -> None:
    second = np.clip(0.5 * warped(gray, TRUE).astype(float) + 60, 0, 255).astype(np.uint8)
    assert error(refined(gray, second, TRUE @ OFF), gray.shape) < 0.15


def test_a_plane_that_fills_most_of_the_image_is_not_pulled_off_it(gray: np.ndarray) -> None:
    """A third of the image moves by two pixels more: the compromise would be wrong everywhere."""
    second = warped(gray, TRUE)
    other = warped(gray, np.array([[1, 0, 2.0], [0, 1, 0], [0, 0, 1]]) @ TRUE)
    third = gray.shape[1] // 3
    second[:, :third] = other[:, :third]
    assert error(refined(gray, second, TRUE @ OFF), gray.shape, gray.shape[1] // 2) < 0.3


def test_a_start_that_tracks_contradict_is_kept(gray: np.ndarray) -> None:
    """The second image is another photograph: tracks agree by chance with some homography."""
    other = cv2.flip(gray, -1)
    np.testing.assert_allclose(refined(gray, other, np.eye(3)), np.eye(3), atol=0.05)


@pytest.fixture(scope="module")
def cones(shared: Path) -> PlaneTracks:
    """The tracks of a rectified pair with depth, relative to the plane with most matches."""
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    images = ImagePair((luma(pair.left), luma(pair.right)))
    matches = Sources(images).learned
    plane = next(planes(images, matches, 0))
    return PlaneTracks(images, plane.matrix, (matches.points0, matches.points1))


def test_a_scene_with_depth_shows_it_relative_to_its_largest_plane(cones: PlaneTracks) -> None:
    assert cones.parallax().shows_depth
    assert cones.parallax().share > 0.3


@pytest.mark.parametrize("off_px", [0.0, 3.0])
def test_a_plane_shows_no_depth(warped_pair: ImagePair, off_px: float) -> None:
    """Nor if some tracked matches end at random places."""
    matches = Sources(warped_pair).learned
    rng = np.random.default_rng(0)
    ends = matches.points1 + rng.normal(0, off_px, matches.points1.shape)
    found = PlaneTracks(warped_pair, WARP, (matches.points0, ends))
    assert not found.parallax().shows_depth
    assert not found.parallax().shows_foreground
    corners = np.array([[20.0, 20], [230, 20], [20, 230], [230, 230]])
    ends = transform_points(corners, found.homography)
    assert transfer_errors(corners, ends, WARP).max() < 0.2


def test_flat_images_keep_the_start_and_show_no_depth() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    found = PlaneTracks(ImagePair((flat, flat)), TRUE)
    np.testing.assert_array_equal(found.homography, TRUE)
    assert not found.parallax().shows_depth
