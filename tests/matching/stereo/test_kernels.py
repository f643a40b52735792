"""The compiled parts of stereo matching, compared with their definitions."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba", reason="needs numba")

from deepdetect.matching.stereo import kernels
from deepdetect.matching.stereo.sgm import (
    CENSUS_RADIUS_X,
    CENSUS_RADIUS_Y,
    aggregate,
    census,
    matching_cost,
)

RNG = np.random.default_rng(0)


def test_the_census_says_which_neighbours_are_darker() -> None:
    gray = np.random.default_rng(0).integers(0, 256, (20, 30), np.uint8)
    words = census(gray)
    x_radius, y_radius = CENSUS_RADIUS_X, CENSUS_RADIUS_Y
    framed = np.pad(gray, ((y_radius, y_radius), (x_radius, x_radius)), mode="edge")
    for y, x in ((0, 0), (7, 12), (19, 29)):
        window = framed[y : y + 2 * y_radius + 1, x : x + 2 * x_radius + 1].ravel()
        darker = np.delete(window, len(window) // 2) < gray[y, x]
        assert f"{int(words[y, x]):062b}" == "".join(str(int(bit)) for bit in darker)


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
        np.testing.assert_array_equal(matching_cost((left, right), smallest, count), sums // 4)


def test_the_paths_are_those_of_the_definition() -> None:
    """Sums over the eight paths, step by step, on a small volume."""
    generator = np.random.default_rng(0)
    gray = generator.integers(0, 256, (9, 14), np.uint8)
    left, right = (generator.integers(0, 2**62, gray.shape, np.uint64) for _ in range(2))
    volume = matching_cost((left, right), -3, 16)
    total = aggregate(gray, volume)
    height, width = gray.shape
    cost = volume.astype(int)
    expected = np.zeros_like(cost)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        path = np.zeros_like(cost)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                before = (y - dy, x - dx)
                path[y, x] = cost[y, x]
                if not (0 <= before[0] < height and 0 <= before[1] < width):
                    continue
                change = abs(int(gray[y, x]) - int(gray[before]))
                large = int(max(100 / (1 + change / 8), 25) * 9 / 4)
                last = path[before]
                steps = np.pad(last, 1, constant_values=10**6)
                near = np.minimum(steps[:-2], steps[2:]) + 45
                path[y, x] += np.minimum.reduce([last, near, np.full(16, last.min() + large)])
                path[y, x] -= last.min()
        expected += path
    np.testing.assert_array_equal(total, expected)


def test_the_best_disparity_is_consistent_and_between_whole_numbers() -> None:
    """Costs as of a view that moved by 3.3 pixels, and chance on three rows."""
    height, width, least, count = 6, 20, -2, 8
    apart = np.arange(count) + least - 3.3
    total = np.tile(np.rint(900 * apart**2), (height, width, 1)).astype(np.uint16)
    total[3:] = RNG.integers(0, 1000, (3, width, count))
    disparity, unique = np.zeros((2, height, width), np.float32)
    consistent = np.zeros((height, width), bool)
    out = (disparity, consistent, unique)
    kernels.best_of_rows(0, height, total, least, count, *out)
    np.testing.assert_allclose(disparity[:3, 4:-2], 3.3, atol=1e-3)
    place = np.arange(width) - 3
    np.testing.assert_array_equal(consistent[:3], np.tile(place >= 0, (3, 1)))
    second = np.sort(np.delete(total[0, 0], [4, 5, 6]))[0]  # no neighbour of the best
    np.testing.assert_allclose(unique[:3, 5:-2], second / total[0, 0].min(), rtol=1e-5)
    for y, x in np.argwhere(consistent[3:]):
        there = x - int(np.rint(disparity[3 + y, x]))
        from_right = [
            total[3 + y, there + d + least, d] if 0 <= there + d + least < width else 65535
            for d in range(count)
        ]
        assert abs(int(np.argmin(from_right)) + least - disparity[3 + y, x]) <= 1.5


def test_parabolas_are_sampled_exactly() -> None:
    place = np.arange(40, dtype=np.float32)
    right = np.tile(0.05 * place**2 - place + 7, (3, 1)).astype(np.float32)
    disparity = RNG.uniform(-2, 2, right.shape).astype(np.float32)
    values, slopes = np.zeros((2, *right.shape), np.float32)
    kernels.sample_rows(0, 3, right, disparity, values, slopes)
    there = (place - disparity)[:, 4:-4]
    np.testing.assert_allclose(values[:, 4:-4], 0.05 * there**2 - there + 7, atol=1e-3)
    np.testing.assert_allclose(slopes[:, 4:-4], 0.1 * there - 1, atol=1e-3)


def test_means_are_of_one_surface() -> None:
    y, x = np.mgrid[:24, :30].astype(np.float32)
    plane = 5 + 0.1 * x - 0.05 * y
    surfaces = np.where(x < 15, plane, np.float32(40))
    noisy = surfaces + RNG.normal(0, 0.1, surfaces.shape).astype(np.float32)
    found = []
    for given in (surfaces, noisy):
        out = np.zeros((20, 26), np.float32)
        kernels.smooth_rows(0, 20, given, 2, np.float32(1), out)
        found.append(out - surfaces[2:-2, 2:-2])
    np.testing.assert_allclose(found[0], 0, atol=1e-5)
    assert found[1].std() < 0.05
