from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest


def test_a_batch_gives_what_its_images_give(
    load_script: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    script = load_script("batches")
    monkeypatch.setattr(script, "SIDES_PX", (32, 40))
    monkeypatch.setattr(script, "BATCH", 2)
    monkeypatch.setattr(script, "ROUNDS", 1)
    rows = script.batch_table().rows
    assert [row[:2] for row in rows[:2]] == [("onnxruntime", 32), ("onnxruntime", 40)]
    for _, _, first, second, faster, difference in rows:
        assert first > 0 < second
        assert faster == pytest.approx(first / second)
        assert difference < 1e-5
