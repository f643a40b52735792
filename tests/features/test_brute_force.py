from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.distance import cdist

from deepdetect.features import matchers
from deepdetect.features.matchers import exact_neighbours, hamming_neighbours, match_descriptors


def naive_neighbours(
    queries: np.ndarray, base: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """All distances in double precision; the lower row first among equals."""
    distances = cdist(queries.astype(np.float64), base.astype(np.float64))
    rows = np.argsort(distances, axis=1, kind="stable")[:, :count]
    return rows, np.take_along_axis(distances, rows, 1)


def assert_exact(queries: np.ndarray, base: np.ndarray, count: int, atol: float = 1e-5) -> None:
    rows, distances = exact_neighbours(queries, base, count, 0)
    expected_rows, expected_distances = naive_neighbours(queries, base, count)
    np.testing.assert_array_equal(rows, expected_rows)
    np.testing.assert_allclose(distances, expected_distances, rtol=1e-5, atol=atol)


def sift_like(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.integers(0, 256, (count, 128)).astype(np.float32)


def on_sphere(rng: np.random.Generator, count: int) -> np.ndarray:
    values = rng.random((count, 128))
    return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("make", [sift_like, on_sphere])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_equals_a_naive_search(make, count: int) -> None:
    rng = np.random.default_rng(count)
    assert_exact(make(rng, 70), make(rng, 90), count)


@pytest.mark.parametrize("block", [1, 90, 91, 700, 6_299, 6_300])
def test_blocks_do_not_change_the_result(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    queries, base = sift_like(rng, 70), sift_like(rng, 90)
    expected = exact_neighbours(queries, base, 2, 0)
    monkeypatch.setattr(matchers, "BLOCK_SIZE", block)
    rows, distances = exact_neighbours(queries, base, 2, 0)
    np.testing.assert_array_equal(rows, expected[0])
    np.testing.assert_array_equal(distances, expected[1])


@pytest.mark.parametrize("signed", [True, False])
def test_bytes_equal_a_naive_search_both_ways(
    signed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where sums are as large as they can be, and where many distances are equal."""
    if not signed:
        product = matchers.session_of(matchers.PRODUCTS / "unsigned.onnx"), 0
        monkeypatch.setattr(matchers, "_byte_product", lambda: product)
    rng = np.random.default_rng(0)
    queries = rng.choice(np.array([0, 255, 3], np.uint8), (170, 128), p=[0.1, 0.8, 0.1])
    base = np.concatenate([queries[:70:2], rng.integers(0, 256, (130, 128), np.uint8)])
    base = np.concatenate([base, base[:40]])
    rows, expected = naive_neighbours(queries, base, 2)
    found, distances = exact_neighbours(queries, base, 2, 0)
    np.testing.assert_array_equal(found, rows)
    np.testing.assert_allclose(distances, expected, rtol=1e-6)
    nearest = naive_neighbours(base, queries, 1)[0][:, 0]
    matches = match_descriptors(queries, base, exact_neighbours, ratio=1, mutual=True)
    kept = (nearest[rows[:, 0]] == np.arange(170)) & (expected[:, 0] < expected[:, 1])
    np.testing.assert_array_equal(matches.indices0, np.flatnonzero(kept))
    np.testing.assert_array_equal(matches.indices1, rows[kept, 0])


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_nothing_has_no_neighbours(kind: type) -> None:
    rows, distances = exact_neighbours(np.empty((0, 64), kind), np.ones((5, 64), kind), 2, 0)
    assert rows.shape == distances.shape == (0, 2)


@pytest.mark.parametrize("noise", [0.3, 1e-4, 0])
def test_mutual_neighbours_are_those_of_a_naive_search(noise: float) -> None:
    rng = np.random.default_rng(1)
    queries = on_sphere(rng, 90)
    base = queries[rng.permutation(90)] + noise * on_sphere(rng, 90)
    base = np.concatenate([base, base[:30] + np.float32(noise / 9)]).astype(np.float32)
    rows, expected = naive_neighbours(queries, base, 2)
    nearest = naive_neighbours(base, queries, 1)[0][:, 0]
    kept = (nearest[rows[:, 0]] == np.arange(90)) & (expected[:, 0] < expected[:, 1])
    matches = match_descriptors(queries, base, exact_neighbours, ratio=1, mutual=True)
    np.testing.assert_array_equal(matches.indices0, np.flatnonzero(kept))
    np.testing.assert_array_equal(matches.indices1, rows[kept, 0])


def small_integers(rows: st.SearchStrategy[int]) -> st.SearchStrategy[np.ndarray]:
    """Few values in few dimensions: many equal distances and duplicates."""
    return rows.flatmap(
        lambda n: hnp.arrays(np.float32, (n, 3), elements=st.integers(0, 3).map(float))
    )


@given(
    queries=small_integers(st.integers(1, 12)),
    base=small_integers(st.integers(2, 40)),
    count=st.integers(1, 2),
)
def test_equals_a_naive_search_among_ties(
    queries: np.ndarray, base: np.ndarray, count: int
) -> None:
    assert_exact(queries, base, count)


@pytest.mark.parametrize("offset", [1.0, 30.0, 1000.0])
def test_neighbours_stay_true_far_from_the_origin(offset: float) -> None:
    """|b|^2 - 2 q.b in single precision drowns small distances in a common offset."""
    rng = np.random.default_rng(0)
    # Multiples of 1/64, so that adding the offset is exact.
    queries = (rng.integers(0, 64, (60, 16)) / 64 + offset).astype(np.float32)
    base = (rng.integers(0, 64, (80, 16)) / 64 + offset).astype(np.float32)
    assert_exact(queries, base, 2)


@pytest.mark.parametrize("gap", [1e-2, 1e-3, 1e-4])
def test_neighbours_stay_true_among_near_duplicates(gap: float) -> None:
    """Three copies of each unit vector, at about 1, 2 and 3 gaps from the query."""
    rng = np.random.default_rng(0)
    queries = on_sphere(rng, 50).astype(np.float64)
    direction = rng.normal(size=queries.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    base = np.concatenate([queries + k * gap * direction for k in (3, 1, 2)]).astype(np.float32)
    rows, distances = exact_neighbours(queries.astype(np.float32), base, 2, 0)
    np.testing.assert_array_equal(rows, np.arange(50)[:, None] + [50, 100])
    np.testing.assert_allclose(distances, np.tile([gap, 2 * gap], (50, 1)), rtol=0.01)


@pytest.mark.parametrize(("queries", "base"), [(1000, 1000), (30_000, 2), (10_000, 40)])
def test_memory_is_bounded_by_the_block(
    queries: int, base: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Working memory is a few times BLOCK numbers, however few descriptors the base holds."""
    monkeypatch.setattr(matchers, "BLOCK_SIZE", 200_000)
    rng = np.random.default_rng(0)
    first = rng.random((queries, 128), np.float32)
    second = rng.random((base, 128), np.float32)
    tracemalloc.start()
    try:
        results = exact_neighbours(first, second, 2, 0)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    working = peak - sum(result.nbytes for result in results)
    assert working < 8 * 4 * 200_000


def bit_distances(queries: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Differing bits of all pairs, one bit at a time."""
    bits = (np.unpackbits(part, axis=1).astype(float) for part in (queries, base))
    return cdist(*bits, "cityblock")


def assert_nearest(queries: np.ndarray, base: np.ndarray, count: int) -> None:
    rows, distances = hamming_neighbours(queries, base, count, 0)
    every = bit_distances(queries, base)
    assert (rows.shape, rows.dtype) == ((len(queries), count), np.int32)
    assert (distances.shape, distances.dtype) == ((len(queries), count), np.float32)
    np.testing.assert_array_equal(distances, np.sort(every, axis=1)[:, :count])
    np.testing.assert_array_equal(np.take_along_axis(every, rows.astype(int), 1), distances)
    assert all(len(set(row)) == count for row in rows.tolist())


def random_bytes(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize("width", [1, 7, 32, 64])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_neighbours_equal_those_of_counting_all_bits(width: int, count: int) -> None:
    assert_nearest(random_bytes(count, 60, width), random_bytes(9, 80, width), count)


def test_the_base_may_be_as_large_as_that_of_any_matcher() -> None:
    """OpenCV's brute force ends at 2^18 rows; ORB with low settings finds more."""
    base = random_bytes(0, (1 << 18) + 3, 8)
    chosen = [0, 5, (1 << 18) - 1, 1 << 18, (1 << 18) + 2]
    rows, distances = hamming_neighbours(base[chosen], base, 2, 0)
    assert rows[:, 0].tolist() == chosen
    assert (distances[:, 0] == 0).all()
    second = np.sort(bit_distances(base[chosen], base), axis=1)[:, 1]
    np.testing.assert_array_equal(distances[:, 1], second)
