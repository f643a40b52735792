from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetect


def test_the_work_is_that_of_the_commands(
    load_script: Callable[[str], ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    photo: np.ndarray,
    tmp_path: Path,
) -> None:
    script = load_script("collection_costs")
    monkeypatch.setattr(script, "WIDTHS_PX", (96, 200))
    monkeypatch.setattr(script, "BUDGETS", (50,))
    monkeypatch.setattr(script, "MAX_DENSE_MEGAPIXELS", 0.02)
    monkeypatch.setattr(script, "TRIES", 1)
    paths = [tmp_path / "left.png", tmp_path / "right.png"]
    for path, view in zip(paths, (photo[:, :240], photo[:, 16:]), strict=True):
        Image.fromarray(view).save(path)
    small, large = script.cost_table(paths).rows
    assert (small[0], large[0]) == ("96x102", "200x213")
    for row in (small, large):
        assert row[1] > 0 < row[5]
        assert row[2] == 50
    expected = DeepDetect(threads=1).detect(script._scaled(paths[0], 96, tmp_path))
    assert small[3] > 0
    assert small[4] == len(expected)
    assert large[3:5] == (None, None)
