from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.features.even_order import even_order


def grid(width: int, height: int) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)


@given(width=st.integers(1, 70), height=st.integers(1, 70))
def test_each_pixel_has_a_rank_of_its_own(width: int, height: int) -> None:
    order = even_order(grid(width, height), (width, height))
    assert order.dtype == np.float32
    assert len(np.unique(order)) == width * height
    assert 0 <= order.min() <= order.max() < 1


@pytest.mark.parametrize("count", [4, 16, 64, 256])
def test_the_first_ones_lie_in_cells_of_their_own(count: int) -> None:
    xy = grid(64, 64)
    first = xy[np.argsort(even_order(xy, (64, 64)))[:count]]
    side = 64 // int(np.sqrt(count))
    assert len(np.unique(first // side, axis=0)) == count


def test_positions_between_pixels_go_with_the_nearest() -> None:
    whole, between = np.array([[3, 5], [10, 2]]), np.array([[3.4, 4.6], [9.7, 2.2]])
    np.testing.assert_array_equal(even_order(between, (16, 16)), even_order(whole, (16, 16)))


def test_no_positions_have_no_ranks() -> None:
    assert even_order(np.empty((0, 2)), (8, 8)).shape == (0,)
