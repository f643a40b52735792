from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from deepdetect import OptionError
from deepdetect.features.matchers import MATCHERS, get_matcher, hamming, match_descriptors
from deepdetect.features.matchers.hamming import hamming_neighbours
from deepdetect.io.image import luma


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


@given(data=st.data(), count=st.integers(1, 2))
def test_neighbours_are_right_among_ties(data: st.DataObject, count: int) -> None:
    values = st.lists(st.integers(0, 3), min_size=2, max_size=12)
    parts = [np.array(data.draw(values), np.uint8)[:, None] for _ in range(2)]
    assert_nearest(*parts, count)


@pytest.mark.parametrize("block", [1, 7, 59, 60, 61])
def test_blocks_do_not_change_the_result(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hamming, "QUERIES", block)
    assert_nearest(random_bytes(0, 60, 32), random_bytes(1, 80, 32), 2)


def test_no_queries_have_no_neighbours() -> None:
    rows, distances = hamming_neighbours(random_bytes(0, 0, 32), random_bytes(1, 5, 32), 2, 0)
    assert rows.shape == distances.shape == (0, 2)


def test_the_base_may_be_as_large_as_that_of_any_matcher() -> None:
    """OpenCV's brute force ends at 2^18 rows; ORB with low settings finds more."""
    base = random_bytes(0, (1 << 18) + 3, 8)
    chosen = [0, 5, (1 << 18) - 1, 1 << 18, (1 << 18) + 2]
    rows, distances = hamming_neighbours(base[chosen], base, 2, 0)
    assert rows[:, 0].tolist() == chosen
    assert (distances[:, 0] == 0).all()
    second = np.sort(bit_distances(base[chosen], base), axis=1)[:, 1]
    np.testing.assert_array_equal(distances[:, 1], second)


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_descriptors_that_are_not_binary_are_an_error(dtype, one_line) -> None:
    binary = random_bytes(0, 5, 32)
    for pair in ((binary.astype(dtype), binary), (binary, binary.astype(dtype))):
        with pytest.raises(OptionError, match="take exact or flann") as caught:
            hamming_neighbours(*pair, 2, 0)
        one_line(caught.value)


def test_it_is_registered_and_serves_the_ratio_test(photo: np.ndarray) -> None:
    assert get_matcher("hamming") is MATCHERS["hamming"] is hamming_neighbours
    parts = [photo[:200, :200], photo[10:210, 5:205]]
    described = [
        cv2.ORB_create().detectAndCompute(luma(np.ascontiguousarray(part)), None)[1]
        for part in parts
    ]
    found = match_descriptors(*described, hamming_neighbours, ratio=0.8, mutual=True)
    every = bit_distances(*described)
    ordered = np.sort(every, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        kept = ordered[:, 0] / ordered[:, 1] < 0.8
    mutual = (every.min(1) == every.min(0)[every.argmin(1)]) & kept
    assert len(found) > 50
    assert set(found.rows0) <= set(np.flatnonzero(kept))
    # Ties among the columns' nearest alone may tell the two apart.
    assert abs(len(found) - mutual.sum()) <= 0.02 * mutual.sum()
