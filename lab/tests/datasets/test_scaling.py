from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect_lab.datasets.scaling import scale_short_side


@given(height=st.integers(16, 300), width=st.integers(16, 300), side=st.integers(16, 300))
def test_the_short_side_is_exact_and_the_shape_is_kept(height: int, width: int, side: int) -> None:
    scaled = scale_short_side(np.zeros((height, width, 3), np.uint8), side)
    assert min(scaled.shape[:2]) == side
    factor = side / min(height, width)
    assert scaled.shape[0] == pytest.approx(height * factor, abs=0.5)
    assert scaled.shape[1] == pytest.approx(width * factor, abs=0.5)


def test_shrinking_averages_areas(photo: np.ndarray) -> None:
    sums = photo.astype(int).reshape(64, 4, 64, 4, 3).sum((1, 3))
    assert np.abs(scale_short_side(photo, 64) - sums / 16).max() <= 0.5
