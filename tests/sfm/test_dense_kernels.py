"""The compiled parts of dense points beside definitions, and planes whose answer is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("numba", reason="needs numba")

from deepdetect.sfm import dense_kernels as kernels

RNG = np.random.default_rng(0)


def plane(height: int, width: int, right: float, down: float, at: float = 0.5) -> np.ndarray:
    """Return (H, W, 3) float32: the inverse depths of a plane and their changes per pixel."""
    y, x = np.mgrid[:height, :width]
    values = np.broadcast_arrays(at + right * x + down * y, right, down)
    return np.stack(values, axis=2).astype(np.float32)


def test_costs_are_the_two_least_distances_in_windows() -> None:
    height, width, count = 6, 9, 4
    census = RNG.integers(0, 2**62, (height, width), np.uint64)
    neighbours = RNG.integers(0, 2**62, (3, 8, 11), np.uint64)
    neighbours[0, 2, 3] |= kernels.HIDDEN
    columns, rows = (
        np.moveaxis(RNG.integers(0, most, (places, 3, count)).astype(np.int32), 0, 2)
        for most, places in ((11, width), (8, height))
    )
    hidden = np.uint8(31)
    distances = np.zeros((3, height, width, count), np.int64)
    for k, y, x, d in np.ndindex(distances.shape):
        word = int(neighbours[k, rows[k, d, y], columns[k, d, x]])
        apart = (word ^ int(census[y, x])).bit_count()
        distances[k, y, x, d] = hidden if word >> 63 else apart
    best = np.sort(distances, axis=0)[:2].sum(0)
    framed = np.pad(best, ((1, 1), (1, 1), (0, 0)), mode="edge")
    sums = sum(framed[j : j + height, i : i + width] for j in range(3) for i in range(3))
    cost = np.zeros((height, width, count), np.uint8)
    for first, last in ((0, 4), (4, height)):
        kernels.cost_rows(first, last, census, neighbours, columns, rows, hidden, cost)
    np.testing.assert_array_equal(cost, sums // 8)


def test_the_least_cost_is_between_whole_numbers() -> None:
    middles = RNG.uniform(1.5, 8.5, (4, 5))
    total = np.rint(1000 * (np.arange(11) - middles[..., None]) ** 2).astype(np.uint16)
    out = np.zeros((4, 5), np.float32)
    kernels.choose_rows(0, 4, total, out)
    np.testing.assert_allclose(out, middles, atol=1e-3)
    total[0, 0] = np.arange(11)  # least at an end
    kernels.choose_rows(0, 1, total, out)
    assert out[0, 0] == 0


def test_planes_are_fitted_to_what_lies_near() -> None:
    planes = plane(9, 12, 0.003, -0.002)
    planes[..., 1:] = 0  # the slants are not known
    weights = np.ones((9, 12), np.float32)
    planes[4, 7, 0] += 1  # another surface, which does not count
    out = np.zeros_like(planes)
    kernels.fit_rows(0, 9, planes, weights, 2, 0.02, 5, out)
    expected = plane(9, 12, 0.003, -0.002)
    assert np.isnan(out[4, 7]).all()
    known = np.ones((9, 12), bool)
    known[4, 7] = False
    np.testing.assert_allclose(out[known], expected[known], atol=1e-5)


def test_depth_maps_of_one_plane_agree() -> None:
    """A second camera half a unit to the right, and a third one that sees another depth."""
    height, width, focal, baseline = 20, 30, 40.0, 0.5
    camera = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    own = plane(height, width, 0.0, 0.0, 0.25)
    neighbours = np.stack([own, own, np.full_like(own, 0.4)])
    neighbours[2, ..., 1:] = 0
    offsets = np.array([[baseline, 0, 0], [-baseline, 0, 0], [0, baseline, 0]])
    there = np.stack([np.column_stack([np.eye(3), -camera @ each]) for each in offsets])
    back = np.stack([np.column_stack([np.eye(3), camera @ each]) for each in offsets])
    fused, views, shown = (
        np.zeros((height, width), kind) for kind in (np.float32, np.uint8, np.uint8)
    )
    sizes = np.full((3, 2), (height, width))
    how = (there, back, np.linalg.inv(camera), offsets, 0.5, 0.01, 0.05)
    kernels.fuse_rows(0, height, own, neighbours, sizes, 1, *how, fused, views, shown)
    inner = np.s_[6:-6, 6:-6]
    np.testing.assert_allclose(fused[inner], 0.25, rtol=1e-5)
    assert (views[inner] == 3).all()
    assert (shown[inner] == 4).all()
    assert (views[inner[0], 0] < 3).all()  # one of them does not show the border


def test_support_is_a_mean_over_a_square() -> None:
    planes, chosen = plane(12, 15, 0.004, 0.001), RNG.random((12, 15)) < 0.5
    support = np.zeros((12, 15), np.float32)
    kernels.support_rows(0, 12, planes, 1, chosen, 2, 1, 0.01, support)
    window = {"ksize": (5, 5), "normalize": False, "borderType": cv2.BORDER_CONSTANT}
    number, inside = (
        cv2.boxFilter(each, cv2.CV_64F, **window) for each in (chosen * 1.0, np.ones((12, 15)))
    )
    np.testing.assert_allclose(support, number / inside, atol=1e-6)
