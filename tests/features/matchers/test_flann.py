from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from deepdetect.features.matchers.exact import exact_neighbours
from deepdetect.features.matchers.flann import flann_neighbours


def sift_like(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 128)).astype(np.float32)


def clustered(seed: int, clusters: int, each: int, spread: float) -> np.ndarray:
    """Descriptors in tight clusters, as real ones are."""
    rng = np.random.default_rng(seed)
    centres = np.random.default_rng(99).random((clusters, 64)) * 100
    points = centres[:, None] + rng.normal(0, spread, (clusters, each, 64))
    return points.reshape(-1, 64).astype(np.float32)


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


def test_distances_are_euclidean_and_ascending() -> None:
    queries, base = sift_like(1, 100), sift_like(2, 500)
    rows, distances = flann_neighbours(queries, base, 3, 0)
    true = np.take_along_axis(cdist(queries, base), rows.astype(int), 1)
    np.testing.assert_allclose(distances, true, rtol=1e-5)
    assert (np.diff(distances, axis=1) >= 0).all()


def test_recall_is_high_on_clusters() -> None:
    base = clustered(0, 300, 10, 1.0)
    queries = clustered(1, 300, 2, 1.0)
    rows, distances = flann_neighbours(queries, base, 1, 0)
    true = cdist(queries, base)
    assert (rows[:, 0] == true.argmin(1)).mean() > 0.8
    # Where it misses, it is not far off, and nothing is nearer than the nearest.
    excess = distances[:, 0] / true.min(1)
    assert excess.min() > 1 - 1e-5
    assert np.median(excess) < 1 + 1e-5
    assert np.quantile(excess, 0.95) < 1.5


def test_finds_copies() -> None:
    base = sift_like(0, 1500)
    order = np.random.default_rng(1).permutation(1500)
    rows, distances = flann_neighbours(base[order], base, 1, 0)
    found = rows[:, 0] == order
    assert found.mean() > 0.95
    np.testing.assert_array_equal(distances[found], 0)


@pytest.mark.parametrize(("size", "count"), [(1, 1), (2, 1), (2, 2), (3, 2)])
def test_a_tiny_base_is_searched_exactly(size: int, count: int) -> None:
    queries, base = sift_like(1, 6), sift_like(2, size)
    rows, distances = flann_neighbours(queries, base, count, 0)
    expected = exact_neighbours(queries, base, count, 0)
    np.testing.assert_array_equal(rows, expected[0])
    np.testing.assert_allclose(distances, expected[1], rtol=1e-6)


def test_a_base_of_equal_descriptors() -> None:
    equal = np.full((200, 16), 7, np.float32)
    rows, distances = flann_neighbours(equal[:5], equal, 2, 0)
    assert ((rows >= 0) & (rows < 200)).all()
    assert (rows[:, 0] != rows[:, 1]).all()
    np.testing.assert_array_equal(distances, 0)


def test_shapes_and_types() -> None:
    rows, distances = flann_neighbours(sift_like(1, 7), sift_like(2, 9), 2, 0)
    assert (rows.shape, rows.dtype) == ((7, 2), np.int32)
    assert (distances.shape, distances.dtype) == ((7, 2), np.float32)
