from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry import transform_points
from deepdetect.matching.stitching.bundle_adjustment import (
    RegisteredPair,
    RotatingCamera,
    adjust_cameras,
    adjust_homographies,
    level_cameras,
)
from deepdetect_lab.evaluation.metrics.homography import corner_error

SIZE = (640, 480)
CAMERA = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])


def turned(degrees: tuple[float, float, float]) -> np.ndarray:
    """The homography of a camera that only rotated, to the frame of one that did not."""
    return CAMERA @ cv2.Rodrigues(np.radians(degrees))[0] @ np.linalg.inv(CAMERA)


TRUE = {
    2: turned((0, 0, 0)),
    0: turned((1, 20, 2)),
    1: turned((-14, 3, -1)),
    5: turned((-15, 21, 4)),
}


def registered(first: int, second: int, shift: float = 0) -> RegisteredPair:
    """The second image is wrong by a shift along x."""
    grid = np.argwhere(np.ones((25, 33)))[:, ::-1] * 20.0
    between = np.linalg.inv(TRUE[second]) @ TRUE[first]
    targets = transform_points(grid, between)
    inside = ((targets >= 0) & (targets <= np.array(SIZE) - 1)).all(1)
    assert inside.sum() > 80
    moved = np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]])
    return RegisteredPair(first, second, moved @ between, grid[inside], int(inside.sum()))


def errors(found: dict[int, np.ndarray]) -> dict[int, float]:
    return {number: corner_error(found[number], TRUE[number], SIZE) for number in TRUE}


PAIRS = [(2, 0), (1, 2), (0, 5), (5, 1)]


@pytest.fixture
def start() -> dict[int, np.ndarray]:
    """Some pixels off, and of any scale; the first as it is."""
    generator = np.random.default_rng(0)
    return {
        number: matrix if number == 2 else -3 * matrix @ turned(generator.normal(0, 0.5, 3))
        for number, matrix in TRUE.items()
    }


def test_exact_pairs_give_the_truth(start: dict[int, np.ndarray]) -> None:
    assert min(error for number, error in errors(start).items() if number != 2) > 2
    pairs = [registered(*pair) for pair in PAIRS]
    found, residual_px = adjust_homographies(start, pairs, dict.fromkeys(TRUE, SIZE))
    assert list(found) == [2, 0, 1, 5]
    assert max(errors(found).values()) < 1e-5
    assert residual_px < 1e-6


def test_a_loop_spreads_the_error_that_a_chain_piles_up(start: dict[int, np.ndarray]) -> None:
    """One pair of a loop is wrong by 4 px: no image takes all of that."""
    pairs = [registered(*pair) for pair in PAIRS]
    wrong = registered(5, 1, 4)
    sizes = dict.fromkeys(TRUE, SIZE)
    chain, _ = adjust_homographies(start, [pairs[0], pairs[1], wrong], sizes)
    loop, residual_px = adjust_homographies(start, [*pairs[:3], wrong], sizes)
    assert errors(chain)[5] > 3.9
    assert errors(loop)[5] < 3
    assert 0.5 < residual_px < 2.5


def test_cameras_that_turned(start: dict[int, np.ndarray]) -> None:
    pairs = [registered(*pair) for pair in PAIRS]
    sizes = dict.fromkeys(TRUE, SIZE)
    cameras, residual_px = adjust_cameras(start, pairs, sizes)
    assert residual_px < 1e-3
    for number, camera in cameras.items():
        assert camera.focal_px == pytest.approx(600, rel=1e-5)
        turn = cameras[2].rotation.T @ camera.rotation
        expected = np.linalg.inv(CAMERA) @ TRUE[number] @ CAMERA
        np.testing.assert_allclose(turn, expected, atol=1e-6)
    # Shifts of one pair are no turns of the cameras: a part remains.
    assert adjust_cameras(start, [registered(2, 0, 40), *pairs[1:]], sizes)[1] > 3


def test_the_horizon_is_level() -> None:
    """Cameras that look up, on a frame that leans: their rows are level again."""
    leaning = cv2.Rodrigues(np.array([0.3, -0.2, 0.25]))[0]
    cameras = {}
    for number, yaw in ((4, -40), (0, 0), (7, 30)):
        pan = cv2.Rodrigues(np.radians([0.0, yaw, 0]))[0]
        cameras[number] = RotatingCamera(
            500.0, leaning @ pan @ cv2.Rodrigues(np.radians([20.0, 0, 0]))[0]
        )
    level = level_cameras(cameras, 0)
    for number, camera in level.items():
        assert camera.rotation[1, 0] == pytest.approx(0, abs=0.01), number
        np.testing.assert_allclose(
            camera.rotation[:, 1] @ [0, 1, 0], np.cos(np.radians(20)), atol=0.01
        )
    assert level[0].rotation[0, 2] == pytest.approx(0, abs=1e-9)  # in the middle
    assert level[7].rotation[0, 2] > 0.3
