from __future__ import annotations

import numpy as np

from deepdetect.features.learned import common_turn, turn_descriptors


def test_turns_add_up_and_keep_lengths() -> None:
    descriptors = np.random.default_rng(0).normal(size=(5, 64)).astype(np.float32)
    angles = np.array([10, 90, -45, 200, 0], np.float32)
    twice = turn_descriptors(turn_descriptors(descriptors, angles), 30)
    np.testing.assert_allclose(twice, turn_descriptors(descriptors, angles + 30), atol=1e-5)
    lengths = np.linalg.norm(descriptors, axis=1)
    np.testing.assert_allclose(np.linalg.norm(twice, axis=1), lengths, rtol=1e-5)
    np.testing.assert_allclose(turn_descriptors(descriptors, 360), descriptors, atol=1e-5)


def test_a_half_turn_changes_the_sign_of_odd_frequencies() -> None:
    signs = turn_descriptors(np.ones((1, 64), np.float32), 180)[0]
    halves = [1] * 16 + 2 * ([-1] * 12 + [1] * 8 + [-1] * 4)
    np.testing.assert_allclose(signs, halves, atol=1e-6)


def test_the_common_turn_is_that_of_most() -> None:
    rng = np.random.default_rng(1)
    degrees = np.concatenate([rng.normal(-3, 2, 60), rng.uniform(0, 360, 40)])
    assert abs((common_turn(degrees) + 180) % 360 - 180 + 3) < 1
    assert common_turn(np.empty(0)) == 0
