"""The census and its distances, beside their definitions."""

from __future__ import annotations

import numpy as np

from deepdetect.reconstruction.stereo.census import (
    REACH_X,
    REACH_Y,
    census,
    matching_cost,
    textured,
)


def test_the_census_tells_which_neighbours_are_darker() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (20, 30), np.uint8)
    words = census(gray)
    framed = np.pad(gray, ((REACH_Y, REACH_Y), (REACH_X, REACH_X)), mode="edge")
    for y, x in ((0, 0), (7, 12), (19, 29)):
        window = framed[y : y + 2 * REACH_Y + 1, x : x + 2 * REACH_X + 1].ravel()
        darker = np.delete(window, len(window) // 2) < gray[y, x]
        assert f"{int(words[y, x]):062b}" == "".join(str(int(bit)) for bit in darker)


def test_light_does_not_change_it() -> None:
    gray = np.random.default_rng(0).integers(0, 100, (20, 30), np.uint8)
    np.testing.assert_array_equal(census(gray), census((gray * 2 + 30).astype(np.uint8)))


def test_costs_are_sums_of_distances() -> None:
    generator = np.random.default_rng(0)
    shape = (9, 14)
    left, right = (generator.integers(0, 2**62, shape, np.uint64) for _ in range(2))
    for smallest, count in ((-3, 16), (0, 5), (-30, 70), (13, 4)):
        distance = np.full((*shape, count), 31)
        for y, x, d in np.ndindex(distance.shape):
            there = x - (d + smallest)
            if 0 <= there < shape[1]:
                distance[y, x, d] = int(left[y, x] ^ right[y, there]).bit_count()
        framed = np.pad(distance, ((1, 1), (1, 1), (0, 0)), mode="edge")
        sums = sum(framed[j : j + 9, i : i + 14] for j in range(3) for i in range(3))
        np.testing.assert_array_equal(matching_cost(left, right, smallest, count), sums // 4)


def test_flat_windows_have_no_texture() -> None:
    gray = np.full((20, 40), 250, np.uint8)
    gray[5, 35] = 200
    found = textured(gray)
    assert found[2:9, 31:40].all()
    assert found.sum() == 63
