from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect.geometry import epipolar_errors, transfer_errors, transform_points
from deepdetect.geometry.estimation import MAX_LOG10_NFA
from deepdetect.geometry.two_view import GUIDING_THRESHOLDS_PX
from deepdetect.io.image import load_image, luma
from deepdetect.matching.guided import initial_geometry as module
from deepdetect.matching.guided.asift import DIRECTIONS, learned_points
from deepdetect.matching.guided.initial_geometry import (
    InitialGeometry,
    estimate_initial_geometry,
    guiding_geometry,
)
from deepdetect.matching.guided.tentative_matches import MAX_SIDE_PX as LONGEST
from deepdetect.matching.guided.tentative_matches import find_tentative_matches

MILD = np.array([[0.9, -0.12, 25.0], [0.15, 0.95, -8.0], [2e-4, -1e-4, 1.0]])
ODD = [
    np.full((64, 80), 90, np.uint8),
    np.zeros((1, 1), np.uint8),
    np.random.default_rng(1).integers(0, 256, (1, 70)).astype(np.uint8),
]


@pytest.fixture(scope="module")
def picture() -> Callable[..., np.ndarray]:
    """One of scikit-image's photographs by its name, as luma of a given width and height."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")

    def read(name: str, size: tuple[int, int]) -> np.ndarray:
        gray = luma(load_image(getattr(data, name)()))
        return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)

    return read


@pytest.fixture(scope="module")
def art(shared: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A rectified pair of a scene with depth, and true matches of pixels seen from the left."""
    folder = shared / "data" / "middlebury" / "art"
    left, right = (luma(load_image(folder / f"{side}.png")) for side in ("left", "right"))
    disparity = cv2.imread(str(folder / "disparity.png"), cv2.IMREAD_UNCHANGED) / 3.0
    row, column = np.nonzero(disparity)
    points0 = np.column_stack([column, row])[::50].astype(float)
    points1 = points0 - np.column_stack([disparity[row, column], np.zeros(len(row))])[::50]
    return left, right, points0, points1


def initial_geometry(
    gray0: np.ndarray, gray1: np.ndarray, model: str = "auto", seed: int = 0
) -> InitialGeometry:
    return estimate_initial_geometry(find_tentative_matches(gray0, gray1), model, seed)


def geometry_of_views(gray0: np.ndarray, gray1: np.ndarray) -> InitialGeometry:
    features = learned_points(gray0, 2000), learned_points(gray1, 2000)
    tentative = find_tentative_matches(gray0, gray1, features)
    return estimate_initial_geometry(tentative, view_keypoints=1000)


def corners(gray: np.ndarray) -> np.ndarray:
    height, width = gray.shape
    last = np.array([width - 1, height - 1])
    return np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * last.astype(float)


def warped(gray: np.ndarray, homography: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.warpPerspective(gray, homography, size, flags=cv2.INTER_CUBIC)


def resized(gray: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """An image in another size, and the map to it: pixel centres are whole numbers."""
    across, down = width / gray.shape[1], height / gray.shape[0]
    way = cv2.INTER_AREA if across < 1 else cv2.INTER_CUBIC
    shift = 0.5 * across - 0.5, 0.5 * down - 0.5
    matrix = np.array([[across, 0, shift[0]], [0, down, shift[1]], [0, 0, 1]])
    return cv2.resize(gray, (width, height), interpolation=way), matrix


def from_the_side(gray: np.ndarray, tilt: int, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """An image rotated and then made narrower by a factor, each pixel the mean of its own."""
    height, width = gray.shape
    rotation = np.eye(3)
    rotation[:2] = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), turn, 1)
    view, narrow = resized(warped(gray, rotation, (width, height)), width // tilt, height)
    return view, narrow @ rotation


def assert_nothing(found: InitialGeometry) -> None:
    assert found.model == "none"
    assert found.matrix is None
    assert found.points0.shape == found.points1.shape == (0, 2)
    assert found.log10_nfa >= MAX_LOG10_NFA


def check_agreeing(found: InitialGeometry) -> None:
    """Its points agree with the matrix."""
    assert 0 < len(found.points0) == len(found.points1) <= len(found.inliers)
    measure = transfer_errors if found.model == "homography" else epipolar_errors
    errors = measure(found.points0, found.points1, found.matrix)
    assert errors.max() < GUIDING_THRESHOLDS_PX[found.model]
    assert found.log10_nfa < MAX_LOG10_NFA


@pytest.mark.parametrize(
    ("model", "homography"),
    [
        ("auto", MILD),
        ("auto", np.array([[0.0, -1, 255], [1, 0, 0], [0, 0, 1]])),  # a quarter turn
        ("homography", np.array([[0.6, 0, 20], [0, 0.6, 30], [0, 0, 1]])),
    ],
)
def test_a_plane_is_found_within_a_pixel_at_its_corners(
    photo: np.ndarray, model: str, homography: np.ndarray
) -> None:
    gray = luma(photo)
    second = warped(gray, homography, (256, 256))
    second = np.clip(second * 0.7 + 20, 0, 255).astype(np.uint8)  # in other light
    found = initial_geometry(gray, second, model)
    assert found.model == "homography"
    assert found.matrix[2, 2] == pytest.approx(1)
    true = transform_points(corners(gray), homography)
    assert transfer_errors(corners(gray), true, found.matrix).max() < 1
    assert found.num_views == 0
    check_agreeing(found)


@pytest.mark.parametrize("factor", [2, 4])
def test_the_centre_of_the_first_pixel_is_the_origin(
    picture: Callable[..., np.ndarray], factor: int
) -> None:
    """Pixels that are the mean of several lie in their middle, not on their first."""
    gray = picture("astronaut", (512, 512))
    small, to_small = resized(gray, 512 // factor, 512 // factor)
    found = initial_geometry(gray, small)
    column, row = np.meshgrid(np.arange(64, 512, 64), np.arange(64, 512, 64))
    places = np.column_stack([column.ravel(), row.ravel()])
    gaps = transform_points(places, found.matrix) - transform_points(places, to_small)
    assert np.abs(gaps.mean(0)).max() < 0.08


@pytest.mark.parametrize(
    ("turn", "swapped"), [pytest.param(0.0, False, marks=pytest.mark.slow), (35.0, True)]
)
def test_a_strong_tilt_needs_simulated_views(
    picture: Callable[..., np.ndarray], turn: float, swapped: bool
) -> None:
    gray = picture("astronaut", (360, 360))
    side, true = from_the_side(gray, 4, turn)
    # The initial geometry counts in pixels of the second image, so the truth is asked for there.
    pair = (side, gray) if swapped else (gray, side)
    true = np.linalg.inv(true) if swapped else true
    found = geometry_of_views(*pair)
    assert found.model == "homography"
    assert found.num_views > 0
    assert len(found.points0) >= 20
    check_agreeing(found)
    tilt = 4 if swapped else 1  # pixels of the long side for one of the short
    errors = transfer_errors(found.points0, found.points1, true)
    assert np.median(errors) < 2 * tilt
    assert np.quantile(errors, 0.9) < 4 * tilt


def test_matches_that_are_there_already_are_not_made_again(
    photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    gray = luma(photo)
    other = warped(gray, MILD, (256, 256))
    expected = initial_geometry(gray, other)
    tentative = find_tentative_matches(gray, other)
    monkeypatch.setattr("deepdetect.matching.guided.tentative_matches.detect_sift", None)
    found = estimate_initial_geometry(tentative)
    np.testing.assert_array_equal(found.matrix, expected.matrix)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("camera", "rocket"),
        pytest.param("rocket", "coins", marks=pytest.mark.slow),
    ],
)
def test_two_images_of_different_things_have_no_geometry(
    picture: Callable[..., np.ndarray], first: str, second: str
) -> None:
    found = geometry_of_views(picture(first, (200, 150)), picture(second, (200, 150)))
    assert_nothing(found)
    assert found.num_views == 2 * DIRECTIONS


def test_a_scene_with_depth_has_a_fundamental_matrix(art: tuple) -> None:
    left, right, points0, points1 = art
    found = initial_geometry(left, right)
    assert found.model == "fundamental"
    assert found.num_views == 0
    check_agreeing(found)
    errors = epipolar_errors(points0, points1, found.matrix)
    assert np.quantile(errors, 0.95) < 1
    # In the rows of the rectified pair, whatever the matrix.
    assert np.median(np.abs(found.points0[:, 1] - found.points1[:, 1])) < 0.5


def test_clear_depth_is_decided_on_small_copies(
    art: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right, points0, points1 = art
    monkeypatch.setattr(module, "COARSE_SIDE_PX", 400)
    monkeypatch.setattr(module, "MIN_COARSE_DEPTH_INLIERS", 50)
    found = guiding_geometry((left, right))
    assert found.model == "fundamental"
    assert found.source is None  # larger copies were not looked at
    errors = epipolar_errors(points0, points1, found.matrix)
    assert np.quantile(errors, 0.95) < 1.5
    limit = GUIDING_THRESHOLDS_PX["fundamental"] * left.shape[1] / 400
    assert epipolar_errors(found.points0, found.points1, found.matrix).max() < limit


def test_depth_that_few_matches_show_is_decided_on_larger_copies(
    art: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "COARSE_SIDE_PX", 400)
    monkeypatch.setattr(module, "MIN_COARSE_DEPTH_INLIERS", 10_000)
    found = guiding_geometry(art[:2])
    assert found.model == "fundamental"
    assert found.source is not None


@pytest.mark.slow
def test_a_large_image_is_shrunk_and_its_matrix_comes_back_at_its_own_size(
    picture: Callable[..., np.ndarray],
) -> None:
    gray = picture("astronaut", (420, 336))
    second = warped(gray, MILD, (420, 336))
    (large0, up0), (large1, up1) = resized(gray, 2000, 1600), resized(second, 1500, 1200)
    assert min(large0.shape[1], large1.shape[1]) > LONGEST
    own, found = initial_geometry(gray, second), initial_geometry(large0, large1)
    assert own.model == found.model == "homography"
    expected = up1 @ MILD @ np.linalg.inv(up0)
    for matrix in (up1 @ own.matrix @ np.linalg.inv(up0), found.matrix):
        true = transform_points(corners(large0), expected)
        gap = transfer_errors(corners(large0), true, matrix)
        assert gap.max() < 1500 / 420  # a pixel of the small images
    assert found.matrix[2, 2] == pytest.approx(1)
    assert found.points0.max() > LONGEST
    errors = transfer_errors(found.points0, found.points1, found.matrix)
    assert errors.max() < GUIDING_THRESHOLDS_PX["homography"] * 1500 / LONGEST + 1e-6


@pytest.mark.parametrize("odd", ODD, ids=lambda odd: f"{odd.shape[1]}x{odd.shape[0]}")
def test_images_without_keypoints_have_no_geometry(odd: np.ndarray, photo: np.ndarray) -> None:
    small = luma(photo)[60:140, 60:140]
    assert_nothing(geometry_of_views(odd, odd))
    assert_nothing(geometry_of_views(odd, small))
    assert_nothing(initial_geometry(small, odd, "fundamental"))
