from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.geometry import transform_points
from deepdetect.geometry.homography_fit import fit_homography_irls
from deepdetect_lab.evaluation.metrics.homography import corner_error

NEARLY = np.array([[1.004, 0.006, 2.0], [-0.005, 0.997, -1.5], [8e-6, -5e-6, 1.0]])
"""A homography by which points move a few pixels, as what is left to correct."""


@given(
    seed=st.integers(0, 2**31),
    turn=st.floats(-0.02, 0.02),
    scale=st.floats(0.99, 1.01),
    across=st.floats(-5, 5),
    bend=st.floats(-2e-5, 2e-5),
)
def test_finds_any_small_homography_of_clean_points(
    seed: int, turn: float, scale: float, across: float, bend: float
) -> None:
    points = np.random.default_rng(seed).uniform(0, (640, 480), (60, 2))
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    homography = np.array([[cos, -sin, across], [sin, cos, -across], [bend, -bend, 1.0]])
    found = fit_homography_irls(points, transform_points(points, homography))
    assert corner_error(found, homography, (640, 480)) < 1e-4
    assert found[2, 2] == 1


def test_wrong_points_pull_less_than_in_least_squares_and_no_more_than_in_magsac() -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform(0, (640, 480), (600, 2))
    there = transform_points(points, NEARLY) + generator.normal(0, 0.1, points.shape)
    there[points[:, 0] < 80] += [4, -3]
    wild = generator.random(600) < 0.1
    there[wild] += generator.normal(0, 30, (wild.sum(), 2))
    rest = np.array([[100.0, 0], [640, 0], [640, 480], [100, 480]])

    def off(homography: np.ndarray) -> float:
        gaps = transform_points(rest, homography) - transform_points(rest, NEARLY)
        return float(np.linalg.norm(gaps, axis=1).max())

    found = off(fit_homography_irls(points, there))
    plain, _ = cv2.findHomography(points, there, 0)
    magsac, _ = cv2.findHomography(points, there, cv2.USAC_MAGSAC, 1.0)
    assert off(plain) > 2
    assert found < 0.2
    assert found < off(magsac) + 0.15
