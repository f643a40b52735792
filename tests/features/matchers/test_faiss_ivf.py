from __future__ import annotations

import sys

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.features.matchers import match_descriptors
from deepdetect.features.matchers.exact import exact_neighbours
from deepdetect.features.matchers.faiss_ivf import FEWEST, faiss_neighbours

faiss = pytest.importorskip("faiss", reason="needs faiss-cpu")


def clustered(seed: int, count: int, kind: type = np.uint8) -> np.ndarray:
    """Bytes around 200 centres, as descriptors of what repeats in an image."""
    centres = np.random.default_rng(0).integers(0, 200, (200, 32))
    generator = np.random.default_rng(seed)
    noise = generator.integers(0, 50, (count, 32))
    return (centres[generator.integers(0, 200, count)] + noise).astype(kind)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_few_descriptors_are_all_compared(kind: type) -> None:
    queries, base = clustered(1, 300, kind), clustered(2, FEWEST - 1, kind)
    rows, distances = faiss_neighbours(queries, base, 2, 0)
    true, expected = exact_neighbours(queries, base, 2, 0)
    np.testing.assert_allclose(distances, expected, rtol=1e-4)
    assert (rows == true).mean() > 0.99  # but for equal distances


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_of_many_nearly_all_neighbours_are_found(kind: type) -> None:
    queries, base = clustered(1, 500, kind), clustered(2, 20_000, kind)
    rows, distances = faiss_neighbours(queries, base, 2, 0)
    _, expected = exact_neighbours(queries, base, 2, 0)
    gaps = queries[:, None].astype(float) - base[rows]
    tolerance = {"rtol": 1e-5} if kind is np.uint8 else {"atol": 5}  # quantised
    np.testing.assert_allclose(distances, np.linalg.norm(gaps, axis=2), **tolerance)
    assert (np.linalg.norm(gaps, axis=2)[:, 0] <= expected[:, 0] + 1e-3).mean() > 0.95


def test_is_the_same_for_a_seed_whatever_the_number_of_threads() -> None:
    queries, base = clustered(1, 500), clustered(2, 20_000)
    before = faiss.omp_get_max_threads()
    found = []
    try:
        for count in (1, 2, 4):
            faiss.omp_set_num_threads(count)
            found.append(faiss_neighbours(queries, base, 2, 3))
    finally:
        faiss.omp_set_num_threads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(found[0][0], other[0])
        np.testing.assert_array_equal(found[0][1], other[1])


def test_a_neighbour_that_was_not_found_makes_no_match(monkeypatch: pytest.MonkeyPatch) -> None:
    def half_blind(queries, base, count, seed, positions=None):  # type: ignore[no-untyped-def]
        rows = np.zeros((len(queries), count), np.int32)
        return rows, np.tile(np.float32([3, np.inf]), (len(queries), 1))

    descriptors = np.zeros((4, 8), np.float32)
    assert len(match_descriptors(descriptors, descriptors, half_blind)) == 0


def test_without_faiss_one_sentence_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    with pytest.raises(OptionError, match=r"pip install 'deepdetect\[faiss\]'"):
        faiss_neighbours(np.zeros((2, 8)), np.zeros((2, 8)), 2, 0)
