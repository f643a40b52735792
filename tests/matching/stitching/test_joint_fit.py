from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.evaluation.metrics.homography import corner_error
from deepdetect.geometry import transform_points
from deepdetect.matching.stitching.joint_fit import Correspondences, fit_jointly

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
    found, residual_px = fit_jointly(start, [correspondences(*pair) for pair in PAIRS], sizes)
    assert list(found) == [2, 0, 1, 5]
    assert max(errors(found).values()) < 1e-5
    assert residual_px < 1e-6


def test_a_loop_spreads_the_error_that_a_chain_piles_up(start: dict[int, np.ndarray]) -> None:
    """One pair of a loop is wrong by 4 px: no image takes all of that."""
    pairs = [correspondences(*pair) for pair in PAIRS]
    wrong = Correspondences(5, 1, pairs[3].points, pairs[3].targets + [4, 0])
    sizes = dict.fromkeys(TRUE, SIZE)
    chain = dict(start)
    chain, _ = fit_jointly(chain, [pairs[0], pairs[1], wrong], sizes)
    loop, residual_px = fit_jointly(start, [*pairs[:3], wrong], sizes)
    assert errors(chain)[5] > 3.9
    assert errors(loop)[5] < 3
    assert 0.5 < residual_px < 2.5


def test_noise_and_some_wrong_correspondences_hardly_matter(start: dict[int, np.ndarray]) -> None:
    generator = np.random.default_rng(1)
    pairs = [correspondences(*pair, 0.3, generator) for pair in PAIRS]
    for pair in pairs:
        pair.targets[::20] += generator.normal(0, 40, pair.targets[::20].shape)
    found, _ = fit_jointly(start, pairs, dict.fromkeys(TRUE, SIZE))
    assert max(errors(found).values()) < 2
