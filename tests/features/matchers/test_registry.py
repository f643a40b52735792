from __future__ import annotations

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.features.matchers import MATCHERS, get_matcher
from deepdetect.features.matchers.exact import exact_neighbours
from deepdetect.features.matchers.flann import flann_neighbours


def test_the_documented_names_exist() -> None:
    assert get_matcher("flann") is flann_neighbours
    assert get_matcher("exact") is exact_neighbours


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("flan", "did you mean 'flann'?"),
        ("FLANN", "did you mean 'flann'?"),
        ("exakt", "did you mean 'exact'?"),
    ],
)
def test_an_unknown_name_brings_the_nearest(name: str, hint: str) -> None:
    with pytest.raises(OptionError) as caught:
        get_matcher(name)
    assert repr(name) in str(caught.value)
    assert hint in str(caught.value)


@pytest.mark.parametrize("name", ["", "brute", None])
def test_a_name_like_no_other_brings_the_whole_list(name: object) -> None:
    with pytest.raises(OptionError, match="known: flann, exact") as caught:
        get_matcher(name)
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize("name", MATCHERS)
@pytest.mark.parametrize("count", [1, 2])
def test_every_matcher_keeps_the_contract(name: str, count: int) -> None:
    if name == "faiss":
        pytest.importorskip("faiss", reason="needs faiss-cpu")
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
