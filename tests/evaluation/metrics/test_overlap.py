from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.evaluation.metrics.overlap import in_front, inside, map_into


def test_an_image_reaches_half_a_pixel_beyond_its_outer_centres() -> None:
    points = np.array([[-0.5, -0.5], [-0.51, 0], [9.49, 4.49], [9.5, 0], [0, 4.5], [np.nan, 0]])
    assert inside(points, (10, 5)).tolist() == [True, False, True, False, False, False]
    assert inside(np.array([[np.inf, 0]]), (10, 5)).tolist() == [False]


def test_points_outside_the_other_image_become_nan() -> None:
    shift = np.array([[1.0, 0, 3], [0, 1, 0], [0, 0, 1]])
    mapped = map_into(np.array([[0, 0], [6, 4], [7, 4]]), shift, (10, 5))
    np.testing.assert_array_equal(mapped, [[3, 0], [9, 4], [np.nan, np.nan]])


@pytest.mark.parametrize("scale", [1.0, -2.5])
def test_beyond_the_horizon_nothing_is_seen(scale: float) -> None:
    # The depth is 1 - x / 100: the horizon is at x = 100.
    homography = scale * np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]])
    points = np.array([[0.0, 0], [99, 0], [101, 0], [-500, 0]])
    assert in_front(points, homography).tolist() == [True, True, False, True]
    # x = -300 + ... at 150 maps to -300, at 50 to 100.
    assert np.isnan(map_into(np.array([[150.0, 0]]), homography, (1000, 10))).all()
    np.testing.assert_allclose(map_into(np.array([[50.0, 0]]), homography, (1000, 10)), [[100, 0]])


@given(
    angle=st.floats(-3, 3),
    scale=st.floats(0.5, 2),
    shift=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    tilt=st.floats(-1e-3, 1e-3),
)
def test_what_is_seen_there_is_found_back(
    angle: float, scale: float, shift: tuple[float, float], tilt: float
) -> None:
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    homography = np.array([[c, -s, shift[0]], [s, c, shift[1]], [tilt, 0, 1]])
    points = np.stack(np.meshgrid(np.arange(0, 64, 7), np.arange(0, 48, 7)), -1).reshape(-1, 2)
    there = map_into(points, homography, (64, 48))
    seen = np.isfinite(there[:, 0])
    assert inside(there[seen], (64, 48)).all()
    back = map_into(there[seen], np.linalg.inv(homography), (64, 48))
    np.testing.assert_allclose(back, points[seen], atol=1e-6)
