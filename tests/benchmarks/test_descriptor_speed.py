from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest

from deepdetect.io.image import luma


def test_a_row_for_each_size(
    load_script: Callable[[str], ModuleType], photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = load_script("descriptor_speed")
    monkeypatch.setattr(script, "KEYPOINTS", 2000)
    monkeypatch.setattr(script, "ROUNDS", 1)
    table = script.descriptor_table(luma(photo))
    titles = [column.title for column in table.columns]
    rows = [dict(zip(titles, row, strict=True)) for row in table.rows]
    assert [row["size"] for row in rows] == list(script.SIZES_PX)
    for row in rows:
        assert row["keypoints"] == 2000
        assert row["equal bytes"] > 0.999
        assert row["largest difference"] <= 1
