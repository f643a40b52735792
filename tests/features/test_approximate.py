from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.features.matchers import (
    flann_neighbours,
)


def sift_like(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 128)).astype(np.float32)


@pytest.mark.parametrize("seed", [0, 5])
@pytest.mark.parametrize("count", [1, 2])
def test_equals_opencvs_matcher_with_5_trees_and_50_checks(seed: int, count: int) -> None:
    queries, base = sift_like(1, 300), sift_like(2, 2000)
    cv2.setRNGSeed(seed)
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
    found = matcher.knnMatch(queries, base, k=count)
    rows, distances = flann_neighbours(queries, base, count, seed)
    np.testing.assert_array_equal(rows, [[match.trainIdx for match in row] for row in found])
    np.testing.assert_allclose(
        distances, [[match.distance for match in row] for row in found], rtol=1e-6
    )


def test_the_seed_decides_the_result() -> None:
    queries, base = sift_like(1, 300), sift_like(2, 2000)
    first = flann_neighbours(queries, base, 2, 3)
    again = flann_neighbours(queries, base, 2, 3)
    other = flann_neighbours(queries, base, 2, 4)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    # Noise is hard for the trees, so other trees find other rows.
    assert not np.array_equal(first[0], other[0])


def test_flann_leaves_the_callers_random_numbers_alone() -> None:
    cv2.setRNGSeed(5)
    expected = cv2.randu(np.zeros(4), 0, 1).copy()
    cv2.setRNGSeed(5)
    flann_neighbours(sift_like(1, 7), sift_like(2, 9), 2, 0)
    np.testing.assert_array_equal(cv2.randu(np.zeros(4), 0, 1), expected)
