from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, match_images
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.io.image import luma
from deepdetect.matching.guided.epipolar import (
    densely_matched,
    match_along_epipolar_lines,
    motion_consistent,
)
from deepdetect.matching.guided.homography import ImagePair
from deepdetect.matching.guided.options import EpipolarMatchingOptions

ROWS = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The fundamental matrix of a rectified pair: y1 = y0."""


def every_pixel(shape: tuple[int, ...]) -> np.ndarray:
    row, column = np.indices(shape[:2])
    return np.column_stack([column.ravel(), row.ravel()]).astype(np.float32)


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A rectified pair: the upper half is 9 px to the left, the lower half 20 px."""
    gray = luma(photo)
    second = np.zeros_like(gray)
    second[:128, :-9] = gray[:128, 9:]
    second[128:, :-20] = gray[128:, 20:]
    return gray, second


def test_each_depth_finds_its_shift(pair: tuple[np.ndarray, np.ndarray]) -> None:
    xy = every_pixel(pair[0].shape)
    found = match_along_epipolar_lines(ImagePair(*pair, xy, xy), ROWS)
    shift = xy[found.rows0] - xy[found.rows1]
    expected = np.where(xy[found.rows0][:, 1] < 128, 9, 20)
    assert (np.abs(shift[:, 1]) <= EpipolarMatchingOptions().max_epipolar_distance_px).all()
    right = np.abs(shift[:, 0] - expected) <= 1
    assert right.mean() > 0.97
    assert len(found) > 0.6 * len(xy)
    assert (found.ratios < 1).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "photograph"),
    [
        ("cones", "chelsea"),
        pytest.param("teddy", "astronaut", marks=pytest.mark.slow),
        pytest.param("art", "rocket", marks=pytest.mark.slow),
    ],
)
def test_what_a_photograph_hides_is_not_matched(name: str, photograph: str, shared: Path) -> None:
    """It covers the middle quarter of the right view."""
    skimage = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    pair = load_middlebury(shared / "data" / "middlebury" / name)
    height, width = pair.right.shape[0] // 2, pair.right.shape[1] // 2
    left, top = width // 2, height // 2
    right = pair.right.copy()
    right[top : top + height, left : left + width] = cv2.resize(
        getattr(skimage, photograph)(), (width, height), interpolation=cv2.INTER_AREA
    )
    found = match_images(pair.left, right, DeepDetect("default"))
    assert found.guided
    assert found.guide.model == "fundamental"

    def under(points: np.ndarray) -> np.ndarray:
        x, y = points.astype(int).T
        there = x - pair.disparity[y, x]
        return (there > left) & (there < left + width) & (y > top) & (y < top + height)

    hidden = under(found.keypoints0.xy).sum()
    assert hidden > 5000
    assert under(found.points0).sum() < 0.02 * hidden
    assert len(found) > 0.3 * (len(found.keypoints0) - hidden)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_very_few_keypoints_are_taken(pair: tuple[np.ndarray, np.ndarray], count: int) -> None:
    xy = every_pixel(pair[0].shape)[5000 : 5000 + count]
    assert len(match_along_epipolar_lines(ImagePair(*pair, xy, xy), ROWS)) <= count


def test_a_pair_that_moves_otherwise_is_told() -> None:
    points0 = every_pixel((20, 20))
    points1 = points0 + np.array([5, 0])
    points1[210] += (7, 0)
    moving = motion_consistent(points0, points1, (20, 20))
    assert not moving[210]
    assert moving[np.arange(400) != 210].all()


def test_a_pair_alone_is_not_trusted() -> None:
    assert motion_consistent(np.array([[3, 3]]), np.array([[5, 3]]), (9, 9)).tolist() == [False]


def test_few_matches_among_many_keypoints_are_dropped() -> None:
    keypoints = every_pixel((80, 160))
    left = keypoints[keypoints[:, 0] < 80]
    some = keypoints[(keypoints[:, 0] >= 110) & (keypoints.sum(axis=1) % 7 == 0)]
    kept = densely_matched(np.concatenate([left, some]), keypoints, (80, 160))
    assert kept[: len(left)].all()
    assert not kept[len(left) :].any()


def test_where_all_match_seldom_seldom_is_enough() -> None:
    keypoints = every_pixel((80, 160))
    some = keypoints[keypoints.sum(axis=1) % 7 == 0]
    assert densely_matched(some, keypoints, (80, 160)).all()
    assert densely_matched(some[:0], keypoints, (80, 160)).tolist() == []
