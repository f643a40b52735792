from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from deepdetect.features.correlation import less_correlated
from deepdetect.features.dense_sift import dense_sift, root
from deepdetect.io.image import luma

DESCRIPTORS = arrays.arrays(np.uint8, (5, 16), elements=st.integers(0, 255))


@given(DESCRIPTORS, DESCRIPTORS)
def test_about_their_own_means_it_is_pearsons_correlation(
    first: np.ndarray, second: np.ndarray
) -> None:
    """Each row and its own mirror image about 127: both have the mean 127.5 throughout."""
    pair = [np.concatenate([part, 255 - part], axis=1) for part in (first, second)]
    rows = np.arange(len(first))
    mean = np.full(32, 127.5, np.float32)
    found = less_correlated(pair[0], rows, pair[1], rows, mean)
    expected = [1 - np.corrcoef(a, b)[0, 1] for a, b in zip(*pair, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_takes_the_rows_it_is_told(photo: np.ndarray) -> None:
    gray = luma(photo)
    generator = np.random.default_rng(0)
    xy = np.column_stack([generator.integers(0, side, 500) for side in gray.shape[::-1]])
    first, second = (root(dense_sift(gray, xy, size)) for size in (3.0, 8.0))
    rows0, rows1 = generator.integers(0, 500, (2, 3000))
    mean = first.mean(axis=0).astype(np.float32)
    found = less_correlated(first, rows0, second, rows1, mean)
    a, b = first[rows0] - mean.astype(float), second[rows1] - mean.astype(float)
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, 1 - (a * b).sum(axis=1) / lengths, atol=1e-5)


def test_what_is_the_mean_tells_nothing() -> None:
    same = np.full((1, 128), 20, np.uint8)
    other = np.arange(128, dtype=np.uint8)[None]
    row, mean = np.array([0]), np.full(128, 20, np.float32)
    for pair in ((same, same), (same, other), (other, same)):
        assert less_correlated(pair[0], row, pair[1], row, mean).tolist() == [1.0]


@pytest.mark.parametrize("count", [0, 1])
def test_takes_none_and_one(count: int) -> None:
    some = np.arange(128, dtype=np.uint8)[None]
    rows = np.zeros(count, np.int64)
    assert less_correlated(some, rows, some, rows, np.zeros(128, np.float32)).shape == (count,)


def test_equal_descriptors_are_exactly_alike() -> None:
    """What tells strangers that are all the same from strangers that are nearly so."""
    generator = np.random.default_rng(0)
    first = generator.integers(0, 256, (20_000, 128)).astype(np.uint8)
    rows = np.arange(len(first))
    for mean in (np.zeros(128, np.float32), first.mean(axis=0).astype(np.float32)):
        assert not less_correlated(first, rows, first.copy(), rows, mean).any()
