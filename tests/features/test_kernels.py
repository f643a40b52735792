"""The compiled parts beside NumPy, SciPy and plain searches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

pytest.importorskip("numba", reason="needs numba")

from deepdetect.features import kernels

RNG = np.random.default_rng(0)


def test_the_nearest_keypoint_is_looked_for_in_nine_pixels() -> None:
    height, width = 12, 15
    pixels = RNG.permutation(height * width)[:60]
    xy = np.column_stack([pixels % width, pixels // width]) + RNG.uniform(-0.4, 0.4, (60, 2))
    grid = np.full((height, width), -1, np.int32)
    grid[pixels // width, pixels % width] = np.arange(60)
    positions = RNG.uniform(-3, 16, (200, 2))
    positions[0] = np.nan
    nearest, distances = np.full(200, -1, np.int32), np.full(200, np.inf)
    kernels.nearest_of_nine(0, 200, positions, xy, grid, nearest, distances)
    for position, row, distance in zip(positions, nearest, distances, strict=True):
        away = np.abs(np.rint(xy) - np.floor(position + 0.5)).max(axis=1)
        near = np.flatnonzero(away <= 1)
        if not len(near):
            assert row == -1
            continue
        gaps = np.linalg.norm(xy[near] - position, axis=1)
        assert (row, distance) == (near[gaps.argmin()], pytest.approx(gaps.min()))


def test_products_give_the_neighbours_both_ways() -> None:
    queries, base = (RNG.integers(0, 30, (n, 8)).astype(np.float32) for n in (70, 150))
    every = cdist(queries, base, "sqeuclidean")
    rows, values = np.zeros((70, 2), np.int32), np.zeros((70, 2), np.float32)
    nearest = np.full(150, -1, np.int32)
    best, second = (np.full(150, np.inf, np.float32) for _ in range(2))
    terms0, terms1 = ((one**2).sum(1) for one in (queries, base))
    for start in (0, 40):  # in two blocks
        part = slice(start, start + 40)
        products = queries[part] @ base.T
        out = (rows[part], values[part], nearest, best, second)
        kernels.scan_products(products, terms0[part], terms1, start, *out)
    np.testing.assert_array_equal(rows, np.argsort(every, axis=1, kind="stable")[:, :2])
    np.testing.assert_array_equal(values, np.sort(every, axis=1)[:, :2])
    np.testing.assert_array_equal(nearest, every.argmin(axis=0))
    np.testing.assert_array_equal([best, second], np.sort(every, axis=0)[:2])


def test_coherent_search_begins_with_two_different_rows() -> None:
    queries, base = RNG.integers(0, 256, (2, 40, 16), np.uint8)
    rows, distances = np.zeros((40, 2), np.int32), np.zeros((40, 2), np.int32)
    kernels.patchmatch_start(0, 40, queries, base, 3, rows, distances)
    every = cdist(queries.astype(float), base.astype(float), "sqeuclidean")
    np.testing.assert_array_equal(distances, np.take_along_axis(every, rows, axis=1))
    assert (rows[:, 0] != rows[:, 1]).all()
    assert (distances[:, 0] <= distances[:, 1]).all()
    assert len(np.unique(rows)) > 30


def test_the_direction_of_a_ramp_is_its_slope() -> None:
    y, x = np.mgrid[:41, :41].astype(np.float32)
    pixels, windows = np.array([[20, 20], [9, 30]]), np.array([3.0, 2.0])
    for degrees in (0, 10, 95, 230, 355):
        turn = np.radians(degrees)
        ramp = np.float32(np.cos(turn)) * x + np.float32(np.sin(turn)) * y
        found = kernels.strongest_directions(ramp, pixels, windows)
        assert np.abs((found - degrees + 180) % 360 - 180).max() < 6
