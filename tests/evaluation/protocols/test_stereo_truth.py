"""A truth of another view is found by the photographs; one of the same view stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.datasets.types import StereoPair
from deepdetect.evaluation.protocols.stereo_truth import (
    AS_IT_IS,
    MOVED,
    baselines_aside,
    moved,
    truths,
    unlike,
)


@pytest.fixture(scope="module")
def cones(shared: Path) -> StereoPair:
    return load_middlebury(shared / "data" / "middlebury" / "cones")


def test_a_truth_of_its_own_photographs_stays(cones: StereoPair, shared: Path) -> None:
    assert baselines_aside(cones) == 0
    assert list(truths(shared / "data" / "middlebury" / "cones")) == [AS_IT_IS]


@pytest.mark.parametrize("aside", [-1, 1])
def test_a_truth_from_aside_is_found(cones: StereoPair, aside: int) -> None:
    """Seen from one baseline to the left, it must be moved one to the right, and back."""
    elsewhere = StereoPair("x", cones.left, cones.right, moved(cones.disparity, -aside))
    assert baselines_aside(elsewhere) == aside
    back = moved(elsewhere.disparity, aside)
    both = np.isfinite(back) & np.isfinite(cones.disparity)
    assert (np.abs(back - cones.disparity)[both] <= 1).mean() > 0.97
    assert unlike(cones, back) < 1.2 * unlike(cones, cones.disparity)


def test_the_truth_of_dolls_is_two_baselines_aside(shared: Path) -> None:
    found = truths(shared / "data" / "middlebury" / "dolls")
    assert list(found) == [AS_IT_IS, MOVED]
    pair = load_middlebury(shared / "data" / "middlebury" / "dolls")
    np.testing.assert_array_equal(found[MOVED], moved(pair.disparity, 2))


def test_the_nearest_place_hides_the_others() -> None:
    row = np.array([[np.nan, 0.0, 0.0, 2.0, 1.0]])
    np.testing.assert_array_equal(moved(row, 1), [[np.nan, 2.0, 0.0, 1.0, np.nan]])
    np.testing.assert_array_equal(moved(row, 0), row)
