from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest

from deepdetect.matching.stereo import DENSE, disparity_map


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("row_matching")


def test_terraces_are_seen_in_the_tenths(script: ModuleType) -> None:
    truth = np.random.default_rng(0).uniform(5, 25, (200, 200))
    assert script.tenths(truth, truth) == "1.00 to 1.00"
    rare, frequent = script.tenths(np.rint(truth), truth).split(" to ")
    assert rare == "0.00"
    assert float(frequent) == pytest.approx(10, rel=0.05)  # all of them are whole pixels
    assert script.tenths(truth, np.rint(truth)) is None


def test_a_row_has_points_shares_and_completeness(script: ModuleType) -> None:
    truth = np.arange(20.0).reshape(4, 5) + 0.55
    found = truth.copy()
    found[0, 0] += 0.75
    found[1, 1] += 3
    found[2] = np.nan
    row = script.scores(found, truth)
    assert row.pop("tenths of a pixel") is None
    assert row.pop("points") == 15
    assert list(row.values()) == pytest.approx([13 / 15, 13 / 15, 14 / 15, 14 / 15, 1, 0.7])


def test_the_ways_are_maps_of_the_left_view(
    script: ModuleType, photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right = photo[:100, :160], photo[:100, 12:172]
    keypoints = np.array([[80, 40], [2, 30], [100, 60]], np.float32)
    maps = {way: compute() for way, compute in script.ways(left, right, keypoints, 32).items()}
    known = {way: np.isfinite(found) for way, found in maps.items()}
    assert not known["keypoints"][30, 2]  # the right view does not show it
    assert (known["parabola"] == known["edges"]).all()
    assert (known["matched"] == disparity_map(left, right, DENSE).matched).all()
    assert known["matched"].sum() < known["dense"].sum()
    middles = {way: np.nanmedian(found) for way, found in maps.items()}
    assert all(abs(middle - 12) < 0.1 for middle in middles.values()), middles
