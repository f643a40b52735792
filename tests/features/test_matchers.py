from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.features import matchers
from deepdetect.features.matchers import (
    MATCHERS,
    DescriptorMatches,
    exact_neighbours,
    get_matcher,
    match_descriptors,
)


def fixed_matcher(
    rows: list[list[int]], distances: list[list[float]]
) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """A matcher with fixed answers."""

    def matcher(
        queries, base, count: int, seed: int, positions=None
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.array(rows, np.int32)[:, :count], np.array(distances, np.float32)[:, :count]

    return matcher


def points(*rows: tuple[float, float]) -> np.ndarray:
    """Descriptors of two numbers, so that distances can be seen by eye."""
    return np.array(rows, np.float32).reshape(-1, 2)


def random_descriptors(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 8)).astype(np.float32)


def pairs(matches: DescriptorMatches) -> set[tuple[int, int]]:
    return set(zip(matches.indices0.tolist(), matches.indices1.tolist(), strict=True))


@pytest.mark.parametrize(
    ("best", "second", "ratio", "kept"),
    [
        (1.0, 2.0, 0.5, False),  # equal to the ratio: not strictly under it
        (1.0, 2.0, 0.5001, True),
        (1.0, 2.0, 0.4999, False),
        (3.0, 3.0, 1.0, False),  # equally good
        (2.999, 3.0, 1.0, True),
        (0.0, 3.0, 1e-6, True),
        (0.0, 0.0, 1.0, False),  # two at distance 0 are equally good: ratio 1
        (1.0, 4.0, 0.99, True),
    ],
)
def test_the_ratio_is_strict(best: float, second: float, ratio: float, kept: bool) -> None:
    one = points((0, 0))
    two = points((0, 0), (1, 1))
    matches = match_descriptors(one, two, fixed_matcher([[1, 0]], [[best, second]]), ratio=ratio)
    assert pairs(matches) == ({(0, 1)} if kept else set())
    if kept:
        np.testing.assert_allclose(matches.ratios, [best / second if second else 1], rtol=1e-6)


@pytest.mark.parametrize("name", ["flann", "exact"])
def test_known_answer(name: str) -> None:
    first = points((0, 0), (10, 0), (0, 10), (5, 5))
    second = points((10, 1), (0, 0), (0, 12), (100, 100))
    matches = match_descriptors(first, second, get_matcher(name), ratio=0.99)
    # (5, 5) is at sqrt(41) from (10, 1) and at sqrt(50) from (0, 0).
    assert matches.indices0.tolist() == [0, 1, 2, 3]
    assert matches.indices1.tolist() == [1, 0, 2, 0]
    expected = [0, 1 / 10, 2 / 10, np.sqrt(41 / 50)]
    np.testing.assert_allclose(matches.ratios, expected, rtol=1e-6)
    strict = match_descriptors(first, second, get_matcher(name), ratio=0.5)
    assert strict.indices0.tolist() == [0, 1, 2]
    both = match_descriptors(first, second, get_matcher(name), ratio=0.99, mutual=True)
    # (10, 1) is nearer to (10, 0) than to (5, 5).
    assert pairs(both) == {(0, 1), (1, 0), (2, 2)}


@pytest.mark.parametrize("mutual", [False, True])
@pytest.mark.parametrize(("count0", "count1"), [(0, 0), (0, 5), (5, 0), (5, 1)])
def test_without_a_second_best_nothing_matches(mutual: bool, count0: int, count1: int) -> None:
    first, second = random_descriptors(0, count0), random_descriptors(1, count1)
    matches = match_descriptors(first, second, get_matcher("exact"), ratio=1.0, mutual=mutual)
    assert matches.indices0.shape == matches.indices1.shape == matches.ratios.shape == (0,)
    assert matches.indices0.dtype == matches.indices1.dtype == np.int32


seeds = st.integers(0, 10_000)
counts = st.integers(2, 40)
ratios = st.floats(0.05, 1.0)


@given(seed=seeds, count0=counts, count1=counts, low=ratios, high=ratios, mutual=st.booleans())
def test_a_lower_ratio_only_removes_matches(
    seed: int, count0: int, count1: int, low: float, high: float, mutual: bool
) -> None:
    low, high = sorted((low, high))
    first, second = random_descriptors(seed, count0), random_descriptors(seed + 1, count1)
    found = {
        ratio: match_descriptors(first, second, get_matcher("exact"), ratio=ratio, mutual=mutual)
        for ratio in (low, high)
    }
    assert pairs(found[low]) <= pairs(found[high])
    kept = found[high].ratios < low
    np.testing.assert_array_equal(found[low].indices0, found[high].indices0[kept])


@given(seed=seeds, count0=counts, count1=counts)
def test_mutual_matches_are_the_same_both_ways(seed: int, count0: int, count1: int) -> None:
    first, second = random_descriptors(seed, count0), random_descriptors(seed + 1, count1)
    there = match_descriptors(first, second, get_matcher("exact"), ratio=1.0, mutual=True)
    back = match_descriptors(second, first, get_matcher("exact"), ratio=1.0, mutual=True)
    assert pairs(there) == {(row0, row1) for row1, row0 in pairs(back)}
    # The two nearest of all are always each other's nearest.
    assert len(there) > 0


@pytest.mark.parametrize("name", MATCHERS)
@pytest.mark.parametrize("count", [1, 2])
def test_every_matcher_keeps_the_contract(name: str, count: int) -> None:
    rng = np.random.default_rng(0)
    queries = rng.random((20, 32), np.float32)
    base = rng.random((30, 32), np.float32)
    if name in ("hamming", "patchmatch"):
        queries, base = (np.rint(part * 255).astype(np.uint8) for part in (queries, base))
    positions = tuple(
        np.column_stack([np.arange(count), np.zeros(count)]).astype(np.float32)
        for count in (20, 30)
    )
    before = queries.copy(), base.copy()
    rows, distances = MATCHERS[name](queries, base, count, 0, positions)
    assert rows.shape == distances.shape == (20, count)
    assert rows.dtype == np.int32
    assert distances.dtype == np.float32
    assert ((rows >= 0) & (rows < 30)).all()
    assert (np.diff(distances, axis=1) >= 0).all()
    np.testing.assert_array_equal(queries, before[0])
    np.testing.assert_array_equal(base, before[1])


def test_auto_takes_patchmatch_only_where_it_suits(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(0)
    base = generator.integers(0, 256, (400, 16)).astype(np.uint8)
    order = generator.permutation(400)
    pixels = np.stack(np.divmod(np.arange(400), 20), 1).astype(np.float32)
    monkeypatch.setattr(matchers, "MAX_EXACT_PRODUCT", 0)
    taken = []

    def spy(*arguments):
        taken.append("patchmatch")
        return exact_neighbours(*arguments)

    monkeypatch.setattr(matchers, "patchmatch_neighbours", spy)
    both, floats = (pixels, pixels[order]), base.astype(np.float32)
    automatic = get_matcher("auto")
    for queries, positions in ((base, (pixels + 0.25, pixels)), (base, None), (floats, both)):
        rows, _ = automatic(queries[order], base, 2, 0, positions)
        assert (rows[:, 0] == order).mean() > 0.9
    assert taken == []
    automatic(base[order], base, 2, 0, both[::-1])
    assert taken == ["patchmatch"]


@pytest.mark.parametrize("name", ["auto", "exact", "hamming"])
def test_the_way_back_of_some_is_that_of_all(name: str) -> None:
    first, second = (random_descriptors(seed, 300).astype(np.uint8) for seed in (0, 1))
    second[:100] = first[100:200] ^ (random_descriptors(2, 100).astype(np.uint8) % 8)
    matcher = get_matcher(name)
    matches = match_descriptors(first, second, matcher, ratio=0.95, mutual=True)
    back = matcher(second, first, 1, 0)[0][:, 0]
    one_way = match_descriptors(first, second, matcher, ratio=0.95)
    expected = {(i, j) for i, j in pairs(one_way) if back[j] == i}
    assert pairs(matches) == expected
    assert 50 <= len(expected) < len(one_way)
