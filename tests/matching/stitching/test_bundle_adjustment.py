from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.metrics.homography import corner_error
from deepdetect.geometry import transform_points
from deepdetect.matching.stitching.bundle_adjustment import (
    Correspondences,
    RotatingCamera,
    adjust_cameras,
    adjust_homographies,
    level_cameras,
)

SIZE = (640, 480)
CAMERA = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])


def turned(degrees: tuple[float, float, float]) -> np.ndarray:
    """The homography of a camera that only turned, to the frame of one that did not."""
    return CAMERA @ cv2.Rodrigues(np.radians(degrees))[0] @ np.linalg.inv(CAMERA)


TRUE = {
    2: turned((0, 0, 0)),
    0: turned((1, 20, 2)),
    1: turned((-14, 3, -1)),
    5: turned((-15, 21, 4)),
}


def correspondences(
    first: int, second: int, noise: float = 0, generator: np.random.Generator | None = None
) -> Correspondences:
    grid = np.argwhere(np.ones((25, 33)))[:, ::-1] * 20.0
    between = np.linalg.inv(TRUE[second]) @ TRUE[first]
    targets = transform_points(grid, between)
    inside = ((targets >= 0) & (targets <= np.array(SIZE) - 1)).all(1)
    assert inside.sum() > 80
    targets = targets[inside]
    if generator is not None:
        targets = targets + generator.normal(0, noise, targets.shape)
    return Correspondences(first, second, grid[inside], targets)


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


def test_exact_correspondences_give_the_truth(start: dict[int, np.ndarray]) -> None:
    assert min(error for number, error in errors(start).items() if number != 2) > 2
    sizes = dict.fromkeys(TRUE, SIZE)
    found, residual_px = adjust_homographies(
        start, [correspondences(*pair) for pair in PAIRS], sizes
    )
    assert list(found) == [2, 0, 1, 5]
    assert max(errors(found).values()) < 1e-5
    assert residual_px < 1e-6


def test_a_loop_spreads_the_error_that_a_chain_piles_up(start: dict[int, np.ndarray]) -> None:
    """One pair of a loop is wrong by 4 px: no image takes all of that."""
    pairs = [correspondences(*pair) for pair in PAIRS]
    wrong = Correspondences(5, 1, pairs[3].points, pairs[3].targets + [4, 0])
    sizes = dict.fromkeys(TRUE, SIZE)
    chain = dict(start)
    chain, _ = adjust_homographies(chain, [pairs[0], pairs[1], wrong], sizes)
    loop, residual_px = adjust_homographies(start, [*pairs[:3], wrong], sizes)
    assert errors(chain)[5] > 3.9
    assert errors(loop)[5] < 3
    assert 0.5 < residual_px < 2.5


def test_noise_and_some_wrong_correspondences_hardly_matter(start: dict[int, np.ndarray]) -> None:
    generator = np.random.default_rng(1)
    pairs = [correspondences(*pair, 0.3, generator) for pair in PAIRS]
    for pair in pairs:
        pair.targets[::20] += generator.normal(0, 40, pair.targets[::20].shape)
    found, _ = adjust_homographies(start, pairs, dict.fromkeys(TRUE, SIZE))
    assert max(errors(found).values()) < 2


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_cameras_that_turned(start: dict[int, np.ndarray], noise: float) -> None:
    generator = np.random.default_rng(2) if noise else None
    pairs = [correspondences(*pair, noise, generator) for pair in PAIRS]
    cameras, residual_px = adjust_cameras(start, pairs, dict.fromkeys(TRUE, SIZE))
    assert residual_px == pytest.approx(noise * 2**0.5, rel=0.1, abs=1e-4)
    for number, camera in cameras.items():
        assert camera.focal_px == pytest.approx(600, rel=0.01 if noise else 1e-5)
        turn = cameras[2].rotation.T @ camera.rotation
        expected = np.linalg.inv(CAMERA) @ TRUE[number] @ CAMERA
        np.testing.assert_allclose(turn, expected, atol=0.005 if noise else 1e-6)
    points = pairs[0].points
    depth = Correspondences(2, 0, points, pairs[0].targets + 30 * np.sin(points[:, :1] / 50))
    assert adjust_cameras(start, [depth, *pairs[1:]], dict.fromkeys(TRUE, SIZE))[1] > 5


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
