from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from deepdetect.geometry import transfer_errors, transform_points
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import ImagePair, Sources
from deepdetect.matching.guided.along_plane import MAX_DISTANCE_PX as REACH
from deepdetect.matching.guided.along_plane import PlaneTracks, match_along_plane
from deepdetect.matching.guided.judge import Judge
from deepdetect.matching.guided.proposals import planes
from deepdetect_lab.datasets.middlebury import load_middlebury

from .conftest import WARP

SHIFT = np.array([[1.0, 0, 9], [0, 1, -6], [0, 0, 1]])
MILD = np.array([[0.95, -0.06, 15.0], [0.08, 0.97, -5.0], [1e-4, -1e-4, 1.0]])


def matched(
    gray0: np.ndarray, gray1: np.ndarray, xy0: np.ndarray, xy1: np.ndarray, homography: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pair = ImagePair((gray0, gray1))
    judge = Judge(pair)
    evidence = judge.along_plane(homography).evidence
    found = match_along_plane(pair, (xy0, xy1), homography, judge, evidence)
    return found.indices0, found.indices1, found.scores


def every_pixel(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()]).astype(np.float32)


def warped(gray: np.ndarray, homography: np.ndarray) -> np.ndarray:
    size = (gray.shape[1], gray.shape[0])
    return cv2.warpPerspective(gray, homography, size, flags=cv2.INTER_CUBIC)


def test_a_shift_by_whole_pixels_matches_each_pixel_with_its_own(photo: np.ndarray) -> None:
    gray = luma(photo)[:120, :160]
    xy = every_pixel(gray)
    rows0, rows1, _ = matched(gray, warped(gray, SHIFT), xy, xy, SHIFT)
    np.testing.assert_array_equal(xy[rows1], xy[rows0] + [9, -6])
    assert len(rows0) > 0.85 * (160 - 9) * (120 - 6)
    assert len(np.unique(rows0)) == len(rows0)


def test_matches_lie_within_reach_of_where_the_homography_takes_them(photo: np.ndarray) -> None:
    gray = luma(photo)
    generator = np.random.default_rng(0)
    xy0, xy1 = (
        every_pixel(gray)[np.sort(generator.permutation(gray.size)[:20_000])] for _ in range(2)
    )
    rows0, rows1, _ = matched(gray, warped(gray, MILD), xy0, xy1, MILD)
    errors = transfer_errors(xy0[rows0], xy1[rows1], MILD)
    assert errors.max() < REACH
    assert len(np.unique(rows0)) == len(rows0)
    # Nearly all that have a partner within reach and are seen.
    there = cv2.perspectiveTransform(xy0[None].astype(float), MILD)[0]
    inside = ((there > 2) & (there < 253)).all(1)
    partner = KDTree(xy1).query(there)[0] < REACH
    assert len(rows0) > 0.9 * np.count_nonzero(inside & partner)


def test_evidence_needs_no_keypoint_with_a_partner(photo: np.ndarray) -> None:
    """It is chance that none has one here: the images show the plane all the same."""
    gray = luma(photo)
    pair = ImagePair((gray, warped(gray, MILD)))
    xy0 = np.stack(np.meshgrid(np.arange(32, 224, 16), np.arange(32, 224, 16)), -1).reshape(-1, 2)
    xy1 = np.rint(transform_points(xy0, MILD)) + 4
    judge = Judge(pair)
    evidence = judge.along_plane(MILD).evidence
    assert len(match_along_plane(pair, (xy0, xy1), MILD, judge, evidence)) == 0
    assert evidence.share > 0.95


@pytest.mark.slow
def test_a_wrong_homography_matches_next_to_nothing(photo: np.ndarray) -> None:
    gray = luma(photo)
    xy = every_pixel(gray)
    wrong = SHIFT @ np.array([[0.0, -1, 255], [1, 0, 0], [0, 0, 1]])
    second = warped(gray, SHIFT)
    right = matched(gray, second, xy, xy, SHIFT)[0]
    assert len(matched(gray, second, xy, xy, wrong)[0]) < 0.05 * len(right)


@pytest.mark.parametrize(
    "homography",
    [
        np.array([[1.0, 0, 5000], [0, 1, 0], [0, 0, 1]]),  # nothing in common
        np.array([[1.0, 0, 0], [0, 1, 0], [-0.02, 0, 1]]),  # the horizon at x = 50
    ],
)
def test_a_homography_to_nowhere_is_taken(photo: np.ndarray, homography: np.ndarray) -> None:
    gray = luma(photo)[:100, :100]
    xy = every_pixel(gray)
    rows0, rows1, _ = matched(gray, gray, xy, xy, homography)
    assert len(rows0) == len(rows1) < 0.5 * len(xy)
    assert (transfer_errors(xy[rows0], xy[rows1], homography) < REACH).all()


TRUE = np.array([[0.97, 0.05, 8.3], [-0.04, 1.02, -5.6], [4e-5, -3e-5, 1.0]])
OFF = np.array([[1.0, 0.004, 2.4], [-0.003, 1.0, -1.7], [0, 0, 1.0]])


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
    assert cones.show_depth()


@pytest.mark.parametrize("off_px", [0.0, 3.0])
def test_a_plane_shows_no_depth(warped_pair: ImagePair, off_px: float) -> None:
    """Nor if some tracked matches end at random places."""
    matches = Sources(warped_pair).learned
    rng = np.random.default_rng(0)
    ends = matches.points1 + rng.normal(0, off_px, matches.points1.shape)
    found = PlaneTracks(warped_pair, WARP, (matches.points0, ends))
    assert not found.show_depth(foreground=True)
    corners = np.array([[20.0, 20], [230, 20], [20, 230], [230, 230]])
    ends = transform_points(corners, found.homography)
    assert transfer_errors(corners, ends, WARP).max() < 0.2


def test_only_free_squares_are_tracked(gray: np.ndarray) -> None:
    """The left two thirds stand still, so that tracks there would lead back to no motion."""
    second, two_thirds = warped(gray, TRUE), 2 * gray.shape[1] // 3
    second[:, :two_thirds] = gray[:, :two_thirds]
    free = np.zeros((30, 45), bool)
    free[:, 31:] = True
    images = ImagePair((gray, second))
    found = PlaneTracks(images, TRUE @ OFF, free=free)
    assert error(found.homography, gray.shape, two_thirds + 20) < 0.3
    assert found.points[0][:, 0].min() > two_thirds


def test_noise_along_a_foreshortened_direction_is_no_depth(shared: Path) -> None:
    """The second image squeezes the first to a fifth of its width; one pixel there is five here."""
    first = luma(load_image(shared / "data/fountain/0004.jpg"))
    first = cv2.resize(first, (640, 480), interpolation=cv2.INTER_AREA)
    squeeze, seen = np.diag([0.2, 1.0, 1.0]), cv2.GaussianBlur(first, (0, 0), 2.5, sigmaY=0.5)
    seen = cv2.warpAffine(seen, squeeze[:2], (128, 480))
    noise = np.random.default_rng(0).normal(0, 10, seen.shape)
    second = np.clip(seen + noise, 0, 255).astype(np.uint8)
    assert not PlaneTracks(ImagePair((first, second)), squeeze).show_depth()


def test_flat_images_keep_the_start_and_show_no_depth() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    found = PlaneTracks(ImagePair((flat, flat)), TRUE)
    np.testing.assert_array_equal(found.homography, TRUE)
    assert not found.show_depth()
