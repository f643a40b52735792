from __future__ import annotations

import numpy as np
import pytest

from deepdetect.guidance.by_epipolar_line import BAND, matches_by_epipolar_line, move_alike
from deepdetect.image import luma

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
    rows0, rows1, ratios = matches_by_epipolar_line(*pair, xy, xy, ROWS)
    shift = xy[rows0] - xy[rows1]
    expected = np.where(xy[rows0][:, 1] < 128, 9, 20)
    assert (np.abs(shift[:, 1]) <= BAND).all()
    right = np.abs(shift[:, 0] - expected) <= 1
    assert right.mean() > 0.97
    assert len(rows0) > 0.6 * len(xy)
    assert (ratios < 1).all()


def test_what_one_image_hides_is_not_matched(pair: tuple[np.ndarray, np.ndarray]) -> None:
    first, second = pair
    generator = np.random.default_rng(0)
    second = second.copy()
    second[60:120, 100:180] = generator.integers(0, 256, (60, 80))
    xy = every_pixel(first.shape)
    rows0, _, _ = matches_by_epipolar_line(first, second, xy, xy, ROWS)
    x, y = xy[rows0].T
    hidden = (y >= 64) & (y < 116) & (x >= 113) & (x < 185)
    assert hidden.sum() < 0.03 * 52 * 72


@pytest.mark.parametrize("count", [0, 1, 2])
def test_very_few_keypoints_are_taken(pair: tuple[np.ndarray, np.ndarray], count: int) -> None:
    xy = every_pixel(pair[0].shape)[5000 : 5000 + count]
    rows0, rows1, ratios = matches_by_epipolar_line(*pair, xy, xy, ROWS)
    assert len(rows0) == len(rows1) == len(ratios) <= count


def test_a_pair_that_moves_otherwise_is_told() -> None:
    points0 = every_pixel((20, 20))
    points1 = points0 + np.array([5, 0])
    points1[210] += (7, 0)
    moving = move_alike(points0, points1, (20, 20))
    assert not moving[210]
    assert moving[np.arange(400) != 210].all()


def test_a_pair_alone_is_not_trusted() -> None:
    assert move_alike(np.array([[3, 3]]), np.array([[5, 3]]), (9, 9)).tolist() == [False]
