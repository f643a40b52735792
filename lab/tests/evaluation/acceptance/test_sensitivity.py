"""Tests of changing the constants of guided matching."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect import Keypoints, Matches
from deepdetect.features.matches import TwoViewGeometry
from deepdetect.matching.guided import along_rows, cells, judge
from deepdetect_lab.evaluation.acceptance import measure, sensitivity
from deepdetect_lab.evaluation.acceptance.pairs import JudgedPair, Truth

PLACES = np.random.default_rng(0).uniform(0, 90, (40, 2))


def test_constants_are_those_that_the_module_defines() -> None:
    found = sensitivity.constants(judge)
    assert found["MIN_WINDOWS"] == judge.MIN_WINDOWS
    assert found["FAR"] == judge.FAR
    assert "CELL_PX" not in found  # of another module
    assert "DISPARITY" not in sensitivity.constants(along_rows)  # no number


@pytest.mark.parametrize(
    ("value", "factor", "expected"),
    [(10, 0.7, 7), (1, 1.4, 2), (2, 0.7, 1), (0.5, 1.4, 0.7), (((2, 0.5), 1), 1.4, ((3, 0.7), 2))],
)
def test_constants_are_scaled(value: Any, factor: float, expected: Any) -> None:
    found = sensitivity.scaled(value, factor)
    assert found == pytest.approx(expected) if isinstance(value, float) else found == expected


def test_a_changed_constant_changes_where_it_is_imported_and_comes_back() -> None:
    before = cells.WINDOW_CELLS
    with sensitivity.changed("WINDOW_CELLS", cells, 22):
        assert (cells.WINDOW_CELLS, judge.WINDOW_CELLS) == (22, 22)
    assert cells.WINDOW_CELLS is judge.WINDOW_CELLS is before


def test_changed_answers_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that is right only while one constant is at most 8."""
    blank = np.zeros((8, 8, 3), np.uint8)

    def family(_: Path) -> Any:
        yield JudgedPair("plane", "0", lambda: (blank, blank), Truth(np.eye(3)))

    def engine() -> Callable[..., Matches]:
        def match(image0: np.ndarray, image1: np.ndarray, seed: int) -> Matches:
            off = 9 if judge.MIN_WINDOWS > 8 else 0
            points = Keypoints(PLACES, np.ones(40), (100, 100))
            geometry = TwoViewGeometry("homography", np.eye(3), "planar", "high")
            ends = PLACES, PLACES + [0, off]
            return Matches(*ends, np.ones(40), np.ones(40, bool), points, points, geometry=geometry)

        return match

    monkeypatch.setitem(measure.FAMILIES, "made", family)
    monkeypatch.setattr(sensitivity, "guided", engine)
    monkeypatch.setattr(sensitivity, "MODULES", (judge.__name__,))
    rows = sensitivity.sensitivity(tmp_path, tmp_path, families=["made"])
    assert len(rows) == 2 * len(sensitivity.constants(judge))
    (worst,) = (row for row in rows if row["changed"])
    assert (worst["constant"], worst["factor"]) == ("MIN_WINDOWS", 1.4)
    assert (worst["right before"], worst["right"], worst["wrong, high"]) == (1, 0, 1)
    assert sensitivity.table(rows).values()[0] == worst
    assert judge.MIN_WINDOWS == 8
