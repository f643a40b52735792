from __future__ import annotations

from itertools import combinations

import pytest

from deepdetect_lab.datasets.pair_selection import (
    FRAME_DISTANCES,
    evenly_spaced,
    sequence_pairs,
    unordered_pairs,
)


@pytest.mark.parametrize("count", [2, 3, 11, 12])
@pytest.mark.parametrize("max_pairs", [1, 2, 5, 60])
def test_pairs_are_evenly_spaced_ones_of_all(count: int, max_pairs: int) -> None:
    """As if all had been listed."""
    every = list(combinations(range(count), 2))
    assert unordered_pairs(count, max_pairs) == evenly_spaced(every, max_pairs)


def test_few_images_have_all_pairs_and_many_have_sixty() -> None:
    assert len(unordered_pairs(11, 60)) == 55
    found = unordered_pairs(20_000, 60)
    assert len(set(found)) == 60
    assert (found[0], found[-1]) == ((0, 1), (19_998, 19_999))
    assert all(0 <= first < second < 20_000 for first, second in found)


def test_a_sequence_has_ten_starts_at_each_of_six_distances() -> None:
    pairs = sequence_pairs(range(51), 60, FRAME_DISTANCES)
    distances = [second - first for first, second in pairs]
    assert [distances.count(d) for d in (1, 3, 5, 10, 15, 20)] == [10] * 6
    assert [first for first, _ in pairs[20:30]] == [0, 5, 10, 15, 20, 25, 30, 35, 40, 45]


def test_missing_frames_are_in_no_pair() -> None:
    frames = [3, 4, 7, 8, 9]
    assert sequence_pairs(frames, 60, (1, 5)) == [(3, 4), (7, 8), (8, 9), (3, 8), (4, 9)]


def test_fewer_pairs_than_distances() -> None:
    assert len(sequence_pairs(range(51), 3, FRAME_DISTANCES)) == 3
