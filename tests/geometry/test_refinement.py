"""Fundamental matrices of partly known cameras, refined by matches."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.geometry import GeometryOptions, epipolar_errors, estimate_geometry
from deepdetect.geometry.camera import Calibration, Camera, fundamental_matrix
from deepdetect.geometry.refinement import refine_fundamental

SIZE = (1200, 800)
SIZES = (SIZE, SIZE)
SIDEWAYS = np.array([-1.0, 0.1, 0.2])
FORWARD = np.array([0.1, 0.0, -1.0])


def matches(
    count: int,
    wrong: int,
    focal: float = 0.9,
    motion: np.ndarray = SIDEWAYS,
    noise: float = 0.4,
    seed: int = 0,
    sizes: tuple[tuple[int, int], tuple[int, int]] = SIZES,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return right matches of a scene 5 to 20 baselines deep, wrong ones, and the true matrix."""
    generator = np.random.default_rng(seed)
    cameras = [Camera(size, focal * max(size)) for size in sizes]
    turn = cv2.Rodrigues(np.radians([3.0, 8.0, -5.0]))[0]
    pixels = generator.uniform((0, 0), sizes[0], (8 * count, 2))
    points = cameras[0].rays(pixels) * generator.uniform(5, 20, (len(pixels), 1))
    there = cameras[1].project(points @ turn.T + motion)
    shown = ((there > 0) & (there < sizes[1])).all(axis=1)
    first, second = pixels[shown][:count], there[shown][:count]
    assert len(first) == count
    first = first + generator.normal(0, noise, first.shape)
    second = second + generator.normal(0, noise, second.shape)
    first = np.concatenate([first, generator.uniform((0, 0), sizes[0], (wrong, 2))])
    second = np.concatenate([second, generator.uniform((0, 0), sizes[1], (wrong, 2))])
    return first, second, fundamental_matrix(Calibration(*cameras), turn, motion)


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_matches_change_nothing(count: int) -> None:
    first, second, true = matches(8, 0)
    kept = refine_fundamental([(first[:count], second[:count])], true, SIZES)
    np.testing.assert_array_equal(kept, true)


@pytest.mark.parametrize(
    ("motion", "share"), [(SIDEWAYS, 1.05), (FORWARD, 0.85)], ids=["sideways", "forward"]
)
def test_a_refined_matrix_is_nearer_to_the_truth(motion: np.ndarray, share: float) -> None:
    """Than one of seven points from the same matches, in the median: where these say little."""
    plain, refined = [], []
    for seed in range(7):
        first, second, _ = matches(80, 0, motion=motion, noise=0.5, seed=seed)
        unseen = matches(300, 0, motion=motion, noise=0, seed=100 + seed)[:2]
        options = GeometryOptions(inlier_threshold=2)
        start = estimate_geometry(first, second, seed=seed, options=options).matrix
        better = refine_fundamental([(first, second)], start, SIZES)
        plain.append(np.quantile(epipolar_errors(*unseen, start), 0.9))
        refined.append(np.quantile(epipolar_errors(*unseen, better), 0.9))
    assert np.median(refined) < share * np.median(plain)


def test_exact_matches_of_an_unusual_camera_outweigh_what_is_usual() -> None:
    """A principal point off the middle, as of a cut-out: matches decide where there are many."""
    cameras = [Camera(SIZE, 1500, (700, 300)), Camera(SIZE, 1500, (700, 300))]
    turn = cv2.Rodrigues(np.radians([2.0, 15.0, 5.0]))[0]
    generator = np.random.default_rng(0)
    pixels = generator.uniform((0, 0), SIZE, (1000, 2))
    points = cameras[0].rays(pixels) * generator.uniform(3, 12, (1000, 1))
    there = cameras[1].project(points @ turn.T + SIDEWAYS)
    start = fundamental_matrix(Calibration(Camera(SIZE, 1500), Camera(SIZE, 1500)), turn, SIDEWAYS)
    assert np.median(epipolar_errors(pixels, there, start)) > 1
    refined = start
    for _ in range(3):  # matches weigh more, the better they fit the matrix before
        refined = refine_fundamental([(pixels, there)], refined, SIZES)
    assert np.quantile(epipolar_errors(pixels, there, refined), 0.95) < 0.1
