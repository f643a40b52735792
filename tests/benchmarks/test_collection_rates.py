from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("collection_rates")


def test_costs_of_each_size(
    script: ModuleType, photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "BUDGETS", (50, 100_000))
    monkeypatch.setattr(script, "MAX_DENSE_PIXELS", 100 * 100)
    monkeypatch.setattr(script, "use_one_thread", lambda: None)  # of all that follows, too
    rows = script.cost_table([photo, photo[::-1]], (96, 128), 1).rows
    assert [row[0] for row in rows] == ["96x96", "128x128"]
    for _, few, many, _, *pair_seconds in rows:
        assert float(few) > 0  # all 50 were found
        assert 50 < int(many.split()[1].strip("()")) < 100_000
        assert min(pair_seconds) > 0
    assert [row[3] is None for row in rows] == [False, True]


def test_the_longer_side_is_scaled(script: ModuleType, photo: np.ndarray) -> None:
    assert script.scaled(photo[:64], 400).shape == (100, 400, 3)


def test_seconds_are_those_of_the_processor(script: ModuleType) -> None:
    seconds, found = script.fastest(lambda: sum(range(200_000)), 2)
    assert found == 199_999 * 100_000
    assert 0 < seconds < 60
