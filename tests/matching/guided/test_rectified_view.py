from __future__ import annotations

import numpy as np

from deepdetect.matching.guided.rectified_view import MIN_CORRELATION, _correlation_bounds


def test_bounds_of_correlation_follow_what_is_found_by_chance() -> None:
    matches = np.linspace(-1, 1, 1000)
    none, some = np.empty(0), np.full(5, 0.1)
    assert _correlation_bounds(matches, none, 100, 2000) == (MIN_CORRELATION, -1)
    # Five in 100 pixels are 100 in 2000: all bounds up to theirs let too many pass.
    assert _correlation_bounds(matches, some, 100, 2000) == (MIN_CORRELATION,) * 2
    assert _correlation_bounds(matches, some, 0, 2000) == (MIN_CORRELATION,) * 2
    many = np.full(5, 0.8)
    assert _correlation_bounds(matches, many, 100, 2000) == (0.8, 0.8)
