from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.features.dense_sift import dense_sift
from deepdetect.io.image import luma
from deepdetect.matching.guided.strangers import BLOCK, BLOCKS, MOVES, choose_strangers, numbered
from deepdetect.matching.guided.verification import SIZES


@pytest.fixture
def gray(photo: np.ndarray) -> np.ndarray:
    return cv2.resize(luma(photo), (301, 240))


@pytest.fixture
def points(gray: np.ndarray) -> np.ndarray:
    row, column = np.indices(gray.shape)
    return np.column_stack([column.ravel(), row.ravel()])[::7]


def everywhere(gray: np.ndarray) -> np.ndarray:
    return np.ones(gray.shape, bool)


def test_under_a_point_of_the_moved_image_lies_its_stranger(
    gray: np.ndarray, points: np.ndarray
) -> None:
    chosen = choose_strangers(points, gray, everywhere(gray), 0)
    assert len(chosen) == len(MOVES)
    for strangers in chosen:
        np.testing.assert_array_equal(np.sort(strangers.rows), np.arange(len(points)))
        here = points[strangers.rows]
        np.testing.assert_array_equal(
            strangers.moved[here[:, 1], here[:, 0]],
            gray[strangers.places[:, 1], strangers.places[:, 0]],
        )
        apart = np.abs(here - strangers.places).max(axis=1)
        assert apart.min() >= min(gray.shape) // 3


@pytest.mark.parametrize("size", SIZES)
def test_whole_descriptors_are_those_of_the_image_that_is_not_moved(
    gray: np.ndarray, points: np.ndarray, size: float
) -> None:
    for strangers in choose_strangers(points, gray, everywhere(gray), 0):
        assert 0.1 < strangers.whole.mean() < 0.9
        moved = dense_sift(strangers.moved, points[strangers.rows], size)
        unmoved = dense_sift(gray, strangers.places, size)
        np.testing.assert_array_equal(moved[strangers.whole], unmoved[strangers.whole])
        assert (moved != unmoved).any(axis=1).mean() > 0.03  # those at an edge are others


def test_strangers_are_seen(gray: np.ndarray, points: np.ndarray) -> None:
    seen = everywhere(gray)
    seen[:, 200:] = False
    for strangers in choose_strangers(points, gray, seen, 0):
        assert 0.3 < len(strangers.rows) / len(points) < 0.9
        assert strangers.places[:, 0].max() < 200


def test_beyond_a_megapixel_blocks_are_chosen_by_the_seed(photo: np.ndarray) -> None:
    gray = cv2.resize(luma(photo), (1472, 1280))
    row, column = np.indices((20, 23))
    points = np.column_stack([column.ravel(), row.ravel()]) * BLOCK + 5
    assert len(points) > BLOCKS
    chosen = [choose_strangers(points, gray, everywhere(gray), seed) for seed in (0, 0, 5)]
    for first, again, other in zip(*chosen, strict=True):
        assert len(first.rows) == BLOCKS
        np.testing.assert_array_equal(first.rows, again.rows)
        assert set(first.rows) != set(other.rows)
    together = {int(row) for strangers in chosen[0] for row in strangers.rows}
    assert len(together) == len(points)  # each move takes others while there are any


def test_each_pixel_has_one_number() -> None:
    pixels = np.array([[3, 1], [0, 0], [3, 1], [2, 2]])
    different, number = numbered(pixels, (3, 4))
    assert {tuple(xy) for xy in different.tolist()} == {(3, 1), (0, 0), (2, 2)}
    np.testing.assert_array_equal(different[number[pixels[:, 1], pixels[:, 0]]], pixels)
    assert (number >= 0).sum() == 3
