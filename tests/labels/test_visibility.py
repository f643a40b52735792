from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect._shared.errors import OptionError
from deepdetect.labels.visibility import LOW_VISIBILITY_RANGE, luma_range, visibility_of


def two_levels(low: int, high: int) -> np.ndarray:
    gray = np.full((20, 20), low, np.uint8)
    gray[:, 10:] = high
    return gray


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 0, "low"),
        (255, 255, "low"),
        (0, 63, "low"),
        (0, 64, "normal"),
        (180, 243, "low"),  # bright, but flat
        (180, 244, "normal"),
        (0, 255, "normal"),
    ],
)
def test_the_rule_at_its_limit(low: int, high: int, expected: str) -> None:
    assert LOW_VISIBILITY_RANGE == 64
    assert luma_range(two_levels(low, high)) == high - low
    assert visibility_of(two_levels(low, high)) == expected


@given(arrays(np.uint8, st.tuples(st.integers(1, 30), st.integers(1, 30))))
def test_the_range_is_that_of_two_percentiles(gray: np.ndarray) -> None:
    low, high = np.percentile(gray, [1, 99], method="inverted_cdf")
    assert luma_range(gray) == float(high) - float(low)


def test_an_unknown_choice() -> None:
    with pytest.raises(OptionError, match="unknown visibility 'lo': did you mean 'low'"):
        visibility_of(two_levels(0, 255), "lo")
