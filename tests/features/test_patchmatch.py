"""Coherent search, beside the exact one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deepdetect import OptionError
from deepdetect._shared import machine
from deepdetect.features.matchers import exact_neighbours, match_descriptors, patchmatch_neighbours
from deepdetect.features.sift import dense_sift
from deepdetect.io.image import luma

SHIFT = np.array([11, 7])


@pytest.fixture(scope="module")
def pair(photo: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Descriptors and pixels of two views of a photograph, the second moved and dimmed."""
    gray = luma(photo)
    views = gray[:150, :150], np.rint(gray[SHIFT[1] :, SHIFT[0] :][:150, :150] * 0.8)
    generator = np.random.default_rng(0)
    row, column = np.indices((150, 150))
    every = np.column_stack([column.ravel(), row.ravel()]).astype(np.float32)
    pixels = [every[generator.random(len(every)) < 0.5] for _ in views]
    described = [
        dense_sift(view.astype(np.uint8), xy) for view, xy in zip(views, pixels, strict=True)
    ]
    return tuple(described), tuple(pixels)


def test_finds_the_moved_points_as_the_exact_search_does(pair) -> None:
    descriptors, positions = pair
    correct = []
    for matcher in (exact_neighbours, patchmatch_neighbours):
        found = match_descriptors(*descriptors, matcher, ratio=0.95, positions=positions)
        moved = positions[0][found.indices0] - positions[1][found.indices1]
        correct.append(int((moved == SHIFT).all(axis=1).sum()))
    assert correct[0] > 1000
    assert correct[1] > 0.9 * correct[0]


def test_the_result_does_not_depend_on_threads_and_is_the_seeds(
    pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    (queries, base), positions = pair
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr(machine, "processor_count", lambda count=count: count)
        found.append(patchmatch_neighbours(queries, base, 2, 4, positions))
    for other in found[1:]:
        np.testing.assert_array_equal(found[0][0], other[0])
        np.testing.assert_array_equal(found[0][1], other[1])
    again = patchmatch_neighbours(queries, base, 2, 5, positions)
    assert not np.array_equal(found[0][0], again[0])


def test_the_order_of_the_keypoints_does_not_matter(pair) -> None:
    (queries, base), positions = pair
    mixed = np.random.default_rng(1).permutation(len(queries))
    rows, distances = patchmatch_neighbours(queries, base, 2, 0, positions)
    found = patchmatch_neighbours(queries[mixed], base, 2, 0, (positions[0][mixed], positions[1]))
    np.testing.assert_array_equal(found[0], rows[mixed])
    np.testing.assert_array_equal(found[1], distances[mixed])


def test_mutual_matches_are_each_others(pair) -> None:
    descriptors, positions = pair
    found = match_descriptors(
        *descriptors, patchmatch_neighbours, ratio=0.95, mutual=True, positions=positions
    )
    back = patchmatch_neighbours(*descriptors[::-1], 1, 0, positions[::-1])[0][:, 0]
    np.testing.assert_array_equal(back[found.indices1], found.indices0)
    assert len(found) > 800


@given(
    counts=st.tuples(st.integers(1, 40), st.integers(2, 40)),
    width=st.sampled_from([1, 3, 200]),
    seed=st.integers(0, 2**31 - 1),
)
@settings(max_examples=40)
def test_any_few_keypoints_get_two_different_neighbours(
    counts: tuple[int, int], width: int, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    descriptors = [generator.integers(0, 256, (count, 16)).astype(np.uint8) for count in counts]
    cells = [generator.choice(200, count, replace=False) for count in counts]
    positions = tuple(np.column_stack([cell % width, cell // width]) for cell in cells)
    rows, distances = patchmatch_neighbours(*descriptors, 2, seed, positions)
    assert rows.shape == (counts[0], 2)
    assert ((rows >= 0) & (rows < counts[1])).all()
    assert (rows[:, 0] != rows[:, 1]).all()
    gaps = descriptors[0][:, None].astype(float) - descriptors[1][rows]
    np.testing.assert_allclose(distances, np.linalg.norm(gaps, axis=2), rtol=1e-5)


def test_what_it_cannot_match_is_refused() -> None:
    queries, base = np.zeros((4, 8), np.uint8), np.zeros((5, 8), np.uint8)
    here = np.arange(8).reshape(4, 2), np.arange(10).reshape(5, 2)
    wrong = [
        (queries, base, 2, None),
        (queries.astype(np.float32), base, 2, here),
        (queries, base, 2, (here[0] + 0.5, here[1])),
        (queries, base, 2, (here[0] - 1, here[1])),
    ]
    for first, second, count, positions in wrong:
        with pytest.raises(OptionError):
            patchmatch_neighbours(first, second, count, 0, positions)
