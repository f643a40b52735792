"""The code of docs/python.md runs, from top to bottom."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

PAGE = Path(__file__).parents[1] / "docs" / "python.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.slow
def test_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    pytest.importorskip("torch", reason="needs torch for the features of LightGlue")
    left, right, _ = data.stereo_motorcycle()
    for name, view in (("left", left), ("right", right)):
        Image.fromarray(view[100:420, 220:620]).save(tmp_path / f"{name}.png")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for number, block in enumerate(BLOCKS):
        exec(compile(block, f"block {number} of {PAGE.name}", "exec"), names)
    assert len(BLOCKS) >= 10
    assert len(names["keypoints"]) > len(names["points"]) == 500
    assert names["matches"].subpixel
    printed = capsys.readouterr().out.splitlines()
    # What the comments say is printed.
    for line in re.findall(r"print\(error\)  # (.*?)(?: \.\.\.)?$", "\n".join(BLOCKS), re.M):
        assert any(text.startswith(line) for text in printed)
