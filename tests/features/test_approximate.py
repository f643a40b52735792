from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect.features.matchers import (
    exact_neighbours,
    faiss_neighbours,
    flann_neighbours,
    match_descriptors,
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


@pytest.fixture(scope="module")
def faiss() -> Any:
    return pytest.importorskip("faiss", reason="needs faiss-cpu")


def quantisable(seed: int, count: int, kind: type = np.uint8) -> np.ndarray:
    """Bytes around 200 centres, as descriptors of what repeats in an image."""
    centres = np.random.default_rng(0).integers(0, 200, (200, 32))
    generator = np.random.default_rng(seed)
    noise = generator.integers(0, 50, (count, 32))
    return (centres[generator.integers(0, 200, count)] + noise).astype(kind)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_few_descriptors_are_all_compared(faiss: Any, kind: type) -> None:
    queries, base = quantisable(1, 300, kind), quantisable(2, 4095, kind)
    rows, distances = faiss_neighbours(queries, base, 2, 0)
    true, expected = exact_neighbours(queries, base, 2, 0)
    np.testing.assert_allclose(distances, expected, rtol=1e-4)
    assert (rows == true).mean() > 0.99  # but for equal distances


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_of_many_nearly_all_neighbours_are_found(faiss: Any, kind: type) -> None:
    queries, base = quantisable(1, 500, kind), quantisable(2, 8_000, kind)
    rows, distances = faiss_neighbours(queries, base, 2, 0)
    _, expected = exact_neighbours(queries, base, 2, 0)
    gaps = queries[:, None].astype(float) - base[rows]
    tolerance = {"rtol": 1e-5} if kind is np.uint8 else {"atol": 5}  # quantised
    np.testing.assert_allclose(distances, np.linalg.norm(gaps, axis=2), **tolerance)
    assert (np.linalg.norm(gaps, axis=2)[:, 0] <= expected[:, 0] + 1e-3).mean() > 0.95


def test_is_the_same_for_a_seed_whatever_the_number_of_threads(faiss: Any) -> None:
    queries, base = quantisable(1, 500), quantisable(2, 8_000)
    before = faiss.omp_get_max_threads()
    found = []
    try:
        for count in (1, 4):
            faiss.omp_set_num_threads(count)
            found.append(faiss_neighbours(queries, base, 2, 3))
    finally:
        faiss.omp_set_num_threads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(found[0][0], other[0])
        np.testing.assert_array_equal(found[0][1], other[1])


def test_a_neighbour_that_was_not_found_makes_no_match() -> None:
    def half_blind(queries, base, count, seed, positions=None):  # type: ignore[no-untyped-def]
        rows = np.zeros((len(queries), count), np.int32)
        return rows, np.tile(np.float32([3, np.inf]), (len(queries), 1))

    descriptors = np.zeros((4, 8), np.float32)
    assert len(match_descriptors(descriptors, descriptors, half_blind)) == 0


def test_flann_leaves_the_callers_random_numbers_alone() -> None:
    cv2.setRNGSeed(5)
    expected = cv2.randu(np.zeros(4), 0, 1).copy()
    cv2.setRNGSeed(5)
    flann_neighbours(sift_like(1, 7), sift_like(2, 9), 2, 0)
    np.testing.assert_array_equal(cv2.randu(np.zeros(4), 0, 1), expected)
