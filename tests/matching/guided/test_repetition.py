"""A wall of one tile, whole and with a part that occurs once, seen a period further on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.matching.guided.repetition import is_repeated

PERIOD_PX = 48
SIZE = (384, 288)
"""Width and height of both views."""


def texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    gray = cv2.GaussianBlur(rng.uniform(0, 255, (height, width)), (0, 0), 2)
    return cv2.normalize(gray, None, 20, 235, cv2.NORM_MINMAX)


def views(unique: bool) -> tuple[np.ndarray, np.ndarray]:
    """The second view begins one period further to the right."""
    rng = np.random.default_rng(0)
    width, height = SIZE
    wall = np.tile(
        texture(rng, PERIOD_PX, PERIOD_PX), (height // PERIOD_PX, width // PERIOD_PX + 1)
    )
    if unique:
        wall[96:192, 144:240] = texture(rng, 96, 96)
    first, second = (
        np.clip(wall[:, left : left + width] + rng.normal(0, 4, (height, width)), 0, 255)
        for left in (0, PERIOD_PX)
    )
    return first.astype(np.uint8), second.astype(np.uint8)


def shift(pixels: float) -> np.ndarray:
    return np.array([[1, 0, pixels], [0, 1, 0], [0, 0, 1.0]])


POINTS = np.argwhere(np.ones(SIZE))[::7].astype(np.float64)


@pytest.mark.parametrize("pixels", [0, -PERIOD_PX])
def test_a_wall_of_one_tile_fits_at_every_period(pixels: float) -> None:
    assert is_repeated(views(unique=False), POINTS, shift(pixels))


def test_a_part_that_occurs_once_tells_the_periods_apart() -> None:
    grays = views(unique=True)
    assert not is_repeated(grays, POINTS, shift(-PERIOD_PX))
    assert is_repeated(grays, POINTS, shift(0))


def test_where_a_wall_ends_tells_nothing() -> None:
    rng = np.random.default_rng(3)
    wall = np.zeros(SIZE[::-1], bool)
    wall[PERIOD_PX:-PERIOD_PX, PERIOD_PX:-PERIOD_PX] = True
    first, second = (
        np.where(wall, gray, texture(rng, *SIZE[::-1]).astype(np.uint8))
        for gray in views(unique=False)
    )
    points = np.argwhere(wall)[::7, ::-1].astype(np.float64)
    assert is_repeated((first, second), points, shift(0))


def test_a_scene_that_does_not_repeat_is_not_repeated() -> None:
    gray = texture(np.random.default_rng(1), *SIZE[::-1]).astype(np.uint8)
    assert not is_repeated((gray, gray), POINTS, np.eye(3))
    turned = np.array([[0.9, -0.2, 60], [0.2, 0.9, -10], [0, 0, 1]])
    seen = cv2.warpPerspective(gray, turned, SIZE)
    assert not is_repeated((gray, seen), POINTS, turned)
