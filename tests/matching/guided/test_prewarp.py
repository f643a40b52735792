from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, match_images
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.datasets.types import StereoPair
from deepdetect.features.matches import Matches
from deepdetect.io.image import luma
from deepdetect.matching.guided.homography import ImagePair
from deepdetect.matching.guided.options import PrewarpOptions
from deepdetect.matching.guided.prewarp import estimate_affinity, prewarp


def turned(image: np.ndarray, degrees: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Turn and scale an image, all of it in view; also the (3, 3) map."""
    angle = np.deg2rad(degrees)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    height, width = image.shape[:2]
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    corners = corners @ linear.T
    to_turned = np.column_stack([linear, -corners.min(axis=0)])
    size = np.ceil(np.ptp(corners, axis=0) - 1e-6).astype(int) + 1
    seen = cv2.warpAffine(image, to_turned, tuple(size.tolist()), flags=cv2.INTER_CUBIC)
    return seen, np.vstack([to_turned, [0, 0, 1]])


def right_ones(matches: Matches, pair: StereoPair, to_turned: np.ndarray) -> tuple[int, float]:
    """Return number and share of the matches within one pixel of the left view of the truth."""
    x, y = matches.points0.astype(int).T
    true = np.column_stack([x - pair.disparity[y, x], y, np.ones(len(x))]) @ to_turned[:2].T
    errors = np.linalg.norm(matches.points1 - true, axis=1)
    errors = errors[np.isfinite(errors)] / np.sqrt(np.linalg.det(to_turned[:2, :2]))
    return int((errors <= 1).sum()), float((errors <= 1).mean())


@pytest.fixture(scope="module")
def cones(shared: Path) -> StereoPair:
    return load_middlebury(shared / "data" / "middlebury" / "cones")


@pytest.fixture(scope="module")
def match(cones: StereoPair) -> Callable[[np.ndarray], Matches]:
    detector = DeepDetect("default")
    return lambda second: match_images(cones.left, second, detector)


@pytest.fixture(scope="module")
def upright(cones: StereoPair, match: Callable[[np.ndarray], Matches]) -> tuple[int, float]:
    return right_ones(match(cones.right), cones, np.eye(3))


@pytest.mark.parametrize(
    ("degrees", "scale"),
    [
        pytest.param(30, 1.3, marks=pytest.mark.slow),
        pytest.param(20, 1, marks=pytest.mark.slow),
        pytest.param(90, 1, marks=pytest.mark.slow),
        pytest.param(0, 1.3, marks=pytest.mark.slow),
    ],
)
def test_a_turned_and_scaled_view_is_matched_nearly_as_well(
    degrees: float,
    scale: float,
    cones: StereoPair,
    match: Callable[[np.ndarray], Matches],
    upright: tuple[int, float],
) -> None:
    second, to_turned = turned(cones.right, degrees, scale)
    matches = match(second)
    assert matches.guided
    assert matches.model == matches.guide.model == "fundamental"
    number, share = right_ones(matches, cones, to_turned)
    assert upright[0] > 45_000
    assert number > 0.75 * upright[0]
    assert share > upright[1] - 0.1


@pytest.mark.slow
def test_a_turned_view_under_a_photograph_is_not_matched(
    photo: np.ndarray, cones: StereoPair, match: Callable[[np.ndarray], Matches]
) -> None:
    height, width = cones.right.shape[0] // 2, cones.right.shape[1] // 2
    left, top = width // 2, height // 2
    right = cones.right.copy()
    right[top : top + height, left : left + width] = cv2.resize(photo, (width, height))
    matches = match(turned(right, 30, 1.3)[0])
    assert matches.guided

    def under(points: np.ndarray) -> int:
        x, y = points.astype(int).T
        x = x - cones.disparity[y, x]
        inside = (x > left) & (x < left + width) & (y > top) & (y < top + height)
        return int(inside.sum())

    assert under(matches.points0) < 0.02 * under(matches.keypoints0.xy)
    assert len(matches) > 20_000


def test_aligned_pairs_are_left_as_they_are() -> None:
    points = np.random.default_rng(0).random((60, 2)) * 300
    parallax = np.column_stack([np.linspace(5, 40, 60), np.zeros(60)])
    assert estimate_affinity(points, points - parallax) is None
    floor = points - np.column_stack([0.1 * points[:, 1], np.zeros(60)])
    assert estimate_affinity(points, floor) is None


def test_the_affinity_of_most_matches_is_found_whatever_the_others_do() -> None:
    generator = np.random.default_rng(0)
    points = generator.random((90, 2)) * 300
    true = np.array([[1.1, -0.5, 20], [0.4, 1.2, -9]])
    there = points @ true[:, :2].T + true[:, 2]
    there[:35] += generator.random((35, 2)) * 80 + 20
    first, second = (estimate_affinity(points, there) for _ in range(2))
    np.testing.assert_allclose(first[:2], true, atol=1e-6)
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    "linear",
    [np.diag([-1.0, 1.0]), np.diag([1.0, 0.1]), np.diag([9.0, 9.0]), np.diag([0.1, 0.1])],
)
def test_an_affinity_that_no_camera_makes_is_not_trusted(linear: np.ndarray) -> None:
    points = np.random.default_rng(0).random((40, 2)) * 100
    assert estimate_affinity(points, points @ linear.T) is None


@pytest.mark.parametrize("count", [0, 2, 20])
def test_too_few_matches_and_matches_on_a_line_give_none(count: int) -> None:
    line = np.column_stack([np.arange(count), np.arange(count)]).astype(float)
    assert estimate_affinity(line, line[:, ::-1] * (1, -1)) is None


def test_the_warped_image_is_the_first_and_its_pixels_stand_for_keypoints(
    photo: np.ndarray,
) -> None:
    gray = luma(photo)
    second, to_turned = turned(gray, 30, 1.2)
    row, column = np.indices(second.shape)
    xy1 = np.column_stack([column.ravel(), row.ravel()])[::3]
    found = prewarp(ImagePair(gray, second, xy1, xy1), to_turned)
    back = np.linalg.inv(to_turned) @ found.to_second  # from the warped image to the first
    np.testing.assert_allclose(back[:2, :2], np.eye(2), atol=1e-9)
    left, top = np.rint(back[:2, 2]).astype(int)
    same = found.pair.gray1[-top : 256 - top, -left : 256 - left][8:-8, 8:-8]
    errors = np.abs(same.astype(float) - gray[8:-8, 8:-8])
    assert errors.mean() < 4
    places = found.pair.xy1 @ found.to_second[:2, :2].T + found.to_second[:2, 2]
    assert (np.linalg.norm(places - xy1[found.rows1], axis=1) < 1).all()
    assert found.pair.gray1.shape[0] <= (1 + 2 * PrewarpOptions().frame_margin) * 256 + 2
    assert (found.pair.xy1 >= 0).all()
    assert (found.pair.xy1 < found.pair.gray1.shape[::-1]).all()


def test_the_fundamental_matrix_goes_with_the_image() -> None:
    generator = np.random.default_rng(0)
    fundamental = generator.normal(size=(3, 3))
    affinity = np.array([[0, 1.1, 3], [-1.1, 0, 90], [0, 0, 1]])
    gray = generator.integers(0, 256, (90, 80)).astype(np.uint8)
    xy = np.array([[5, 5], [9, 40]])
    found = prewarp(ImagePair(gray, gray, xy, xy), affinity)
    x0, x = generator.random((2, 3))
    np.testing.assert_allclose(
        x @ found.fundamental(fundamental) @ x0, (found.to_second @ x) @ fundamental @ x0
    )
