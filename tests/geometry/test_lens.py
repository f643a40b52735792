"""Lenses that bend lines, recognised from matches of a random scene seen by known cameras."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry.lens import deviations, distortion

SIZE, FOCAL = (1200, 800), 900.0
CENTRE = (np.array(SIZE) - 1) / 2


def seen(points: np.ndarray, lens: str) -> np.ndarray:
    """Pixels of (N, 3) points in front of a camera whose lens shows them all."""
    if lens == "pinhole":
        return FOCAL * points[:, :2] / points[:, 2:] + CENTRE
    radius = np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    angle = np.arctan2(radius, points[:, 2:])
    if lens == "equidistant":
        return 500 * angle * points[:, :2] / radius + CENTRE
    camera = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
    bend = np.array([{"barrel": -0.2, "weak barrel": -0.05}[lens], 0, 0, 0])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera, bend)[0][:, 0]


def matches(
    lens: str, *, seed: int = 0, plane: bool = False, turn: float = 0.2, shift: float = 1.0
):
    """Matches with noise, of which a third are wrong, and those in the middle as `agreeing`."""
    rng = np.random.default_rng(seed)
    wide = 1.0 if lens in ("equidistant", "pinhole") else 0.75
    points = rng.uniform((-wide, -0.6, 1), (wide, 0.6, 1), (900, 3))
    points *= 5.0 if plane else rng.uniform(3, 12, (900, 1))
    rotation = cv2.Rodrigues(np.array([0.05, turn, 0.1]))[0]
    moved = (points - shift * np.array([1.0, 0.2, 0.3])) @ rotation.T
    first, second = seen(points, lens), seen(moved, lens)
    inside = moved[:, 2] > 0.5
    for xy in (first, second):
        inside &= ((xy > 0) & (xy < SIZE)).all(axis=1)
    first, second = first[inside], second[inside]
    wrong = rng.uniform(size=len(first)) < 1 / 3
    second[wrong] = rng.uniform(0, SIZE, (wrong.sum(), 2))
    near = np.linalg.norm(first - CENTRE, axis=1) < 250
    noise = rng.normal(0, 0.5, (2, *first.shape))
    return first + noise[0], second + noise[1], near & ~wrong, (SIZE, SIZE)


@pytest.mark.parametrize("scene", [{}, {"plane": True}, {"shift": 0.0}, {"turn": 0.0}, {"seed": 1}])
def test_a_fisheye_is_told_from_a_pinhole(scene: dict) -> None:
    corner = np.linalg.norm(CENTRE) / 500  # radians from the axis
    inwards = 1 - corner / np.tan(corner)
    assert distortion(*matches("equidistant", **scene)) == pytest.approx(inwards, abs=0.16)
    assert distortion(*matches("pinhole", **scene)) == 0


def test_barrel_distortion_counts_only_where_it_is_strong() -> None:
    assert distortion(*matches("barrel")) in (0.2, 0.3)
    assert distortion(*matches("weak barrel")) == 0


@pytest.mark.parametrize("seed", range(5))
def test_chance_and_few_matches_show_no_lens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(0, SIZE, (2, 400, 2))
    assert distortion(first, second, rng.uniform(size=400) < 0.1, (SIZE, SIZE)) == 0
    assert distortion(*(part[:20] for part in matches("equidistant")[:3]), (SIZE, SIZE)) == 0


@pytest.mark.parametrize("seed", range(5))
def test_two_motions_are_no_lens(seed: int) -> None:
    """The middle of the image turns by itself, and the rest is shifted."""
    rng, side = np.random.default_rng(seed), 256
    first = rng.uniform(0, side, (500, 2))
    middle = np.linalg.norm(first - side / 2, axis=1) < 100
    turn = cv2.getRotationMatrix2D((side / 2, side / 2), 20, 1)
    turned = first @ turn[:, :2].T + turn[:, 2]
    second = np.where(middle[:, None], turned, first + (7, 4)) + rng.normal(0, 0.3, (500, 2))
    for agreeing in (middle, ~middle):
        assert distortion(first, second, agreeing, ((side, side), (side, side))) == 0


def test_deviations_of_a_constant_fall_in_noise() -> None:
    falls = np.tile([0.0, 2.0], 50)  # mean 1, standard deviation 1
    assert deviations(falls + 3, np.full(100, 3.0)) == pytest.approx(10)
