"""A wall of one tile, whole and with a part that occurs once, seen a period further on; a plane."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.transforms import transform_points
from deepdetect.matching.guided.evidence import compare_held_out, is_repeated, moving_alike

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


def test_what_stands_before_a_wall_tells_the_periods_apart() -> None:
    grays, rng = views(unique=False), np.random.default_rng(4)
    points = rng.uniform(0, SIZE, (40, 2))
    moved = points + np.column_stack([np.zeros(40), rng.uniform(10, 60, 40)])  # along columns
    wrong = rng.uniform(0, SIZE, (40, 2)), rng.uniform(0, SIZE, (40, 2))
    sparse = np.concatenate([points, wrong[0]]), np.concatenate([moved, wrong[1]])
    assert not is_repeated(grays, POINTS, shift(0), sparse)
    assert is_repeated(grays, POINTS, shift(-PERIOD_PX), sparse)
    assert is_repeated(grays, POINTS, shift(0), wrong)
    along_rows = points + (moved - points)[:, ::-1]  # as the periods do
    assert is_repeated(grays, POINTS, shift(0), (points, along_rows))


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


def test_what_is_written_in_a_table_tells_its_cells_apart() -> None:
    """In the small copies, the numbers in the cells of a large page look alike."""
    rng, page = np.random.default_rng(5), np.full((1120, 800), 245, np.uint8)
    for y in range(0, 1120, 40):
        page[y : y + 2] = 60
        for x in range(0, 800, 100):
            page[y : y + 40, x : x + 2] = 60
            text = f"{rng.integers(1000, 9999)}"
            cv2.putText(page, text, (x + 20, y + 27), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 30)
    points = np.argwhere(page < 100)[::7, ::-1].astype(np.float64)
    assert not is_repeated((page, page), points, np.eye(3), flat=True)
    down = np.array([[1, 0, 0], [0, 1, 40], [0, 0, 1.0]])
    assert is_repeated((page, page), points, down, flat=True)
    page[:] = np.tile(page[40:80, 100:200], (28, 8))
    assert is_repeated((page, page), points, np.eye(3), flat=True)


def test_a_scene_that_does_not_repeat_is_not_repeated() -> None:
    gray = texture(np.random.default_rng(1), *SIZE[::-1]).astype(np.uint8)
    assert not is_repeated((gray, gray), POINTS, np.eye(3))
    turned = np.array([[0.9, -0.2, 60], [0.2, 0.9, -10], [0, 0, 1]])
    seen = cv2.warpPerspective(gray, turned, SIZE)
    assert not is_repeated((gray, seen), POINTS, turned)


PLANE_SIZE = (480, 360)
"""Width and height of both views of a plane of which some matches, or all, are moved away."""

WARP = np.array([[0.95, -0.1, 40], [0.1, 0.95, -10], [1e-4, 0, 1]])


@pytest.fixture(scope="module")
def grays() -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(0).uniform(0, 255, PLANE_SIZE[::-1])
    first = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX)
    return first.astype(np.uint8), cv2.warpPerspective(first, WARP, PLANE_SIZE).astype(np.uint8)


@pytest.fixture(scope="module")
def points() -> tuple[np.ndarray, np.ndarray]:
    points0 = np.argwhere(np.ones(PLANE_SIZE))[::3].astype(np.float64)
    points1 = transform_points(points0, WARP)
    seen = ((points1 >= 0) & (points1 < PLANE_SIZE)).all(axis=1)
    return points0[seen], points1[seen]


def test_right_matches_predict_what_looks_alike(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    correlation, alike = compare_held_out(grays, *points)
    assert correlation > 0.99
    assert alike.mean() > 0.98
    correlation, alike = compare_held_out(grays, points[0], points[1] + [8, 0])
    assert correlation < 0.3
    assert alike.mean() < 0.3


def test_images_contradict_the_matches_that_are_moved(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    moved = points[0][:, 0] < 120
    correlation, alike = compare_held_out(grays, points[0], points[1] + 12.0 * moved[:, None])
    assert correlation > 0.99
    assert alike[moved].mean() < 0.2
    assert alike[~moved].mean() > 0.9


def test_of_few_matches_nothing_is_known(
    grays: tuple[np.ndarray, np.ndarray], points: tuple[np.ndarray, np.ndarray]
) -> None:
    correlation, alike = compare_held_out(grays, points[0][::2000], points[1][::2000])
    assert correlation == 0
    assert alike.all()


def test_matches_of_a_pattern_at_random_periods_do_not_move_alike() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1000, (130, 2))
    turned = points @ [[0.6, 0.5], [-0.5, 0.7]] + rng.normal(0, 0.5, points.shape)
    turned[:20] = rng.uniform(0, 1000, (20, 2))
    alike = moving_alike(points, turned) >= 0.6
    assert alike[:20].mean() < 0.2
    assert alike[20:].mean() > 0.9
    periods = np.column_stack([120.0 * rng.integers(-3, 4, 130), np.zeros(130)])
    assert (moving_alike(points, points + periods) >= 0.6).mean() < 0.03
    steps = np.column_stack([80.0 * (points[:, 0] // 250 % 3), np.zeros(130)])  # of depth
    assert (moving_alike(points, points + steps) >= 0.6).mean() > 0.8


def test_as_many_move_alike_as_brute_force_finds() -> None:
    """Some matches begin at one place; each match is compared with its eight nearest."""
    rng = np.random.default_rng(0)
    points0 = rng.uniform(0, 900, (1100, 2))
    points1 = points0 @ [[0.6, 0.5], [-0.5, 0.7]] + rng.normal(0, 9, points0.shape)
    few0, few1 = points0[:9].copy(), points1[:9].copy()  # all the others are the nearest
    few0[4] = few0[3] = few0[2]
    same0, same1 = points0[:40].copy(), points1[:40].copy()  # more are at one place than compared
    same0[:12], same1[:12] = same0[0], same1[0]
    for start, end in ((points0, points1), (few0, few1), (same0, same1)):
        expected = []
        for own in range(len(start)):
            order = np.argsort(np.linalg.norm(start - start[own], axis=1), kind="stable")
            nearest = [k for k in order if k != own][:8]
            steps, ends = (each[nearest] - each[own] for each in (start, end))
            moved = np.linalg.norm(steps, axis=1) > 0
            steps, ends = steps[moved] @ [1, 1j], ends[moved] @ [1, 1j]
            moves = ends / steps
            allowed = 0.35 * np.abs(moves)[:, None] + 2 / np.abs(steps)
            alike = np.abs(moves[:, None] - moves) < allowed
            expected.append(alike.sum(axis=1).max(initial=0) / 8)
        with np.errstate(all="ignore"):  # of steps of no length
            found = moving_alike(start, end)
        np.testing.assert_allclose(found, expected)
        assert len(set(expected)) > 3
